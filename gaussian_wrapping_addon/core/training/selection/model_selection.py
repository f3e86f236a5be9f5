# SPDX-License-Identifier: GPL-3.0-or-later
"""What a scene needs: decisions with their evidence, and the rules that need no rendering.

docs/method.md, section 4.4: more model than needed costs time and invites error, so each part of
the model is switched on by what the photos say, says why, and can be overridden by a setting.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...errors import UsageError
from ...settings import SELECTION_MODES

ON, OFF = "on", "off"

TWO_SIDED_ERROR = 0.5
"""Mean normal error from which a Gaussian counts as seen against its orientation: 60 degrees. One
that is seen from both sides alike has about 1, whatever way it points."""

WRAPPING_SHARE = 0.04
"""Share of the shown surface with at least that error from which wrapping is needed. Contours and
creases of a solid leave some behind that clones would not mend: 1.6 to 2.4 % on rendered solids, up
to 3.1 % on real photos, where spokes and a thin cup have 10 % (640 pixels)."""


@dataclass(frozen=True)
class Decision:
    """One thing that was decided for a scene, and why."""

    name: str
    """Which; the setting's name of :class:`~.settings.TrainingSettings` where there is one."""
    setting: str
    """What was asked for: ``"auto"``, ``"on"`` or ``"off"``."""
    chosen: str
    """What was done: ``"on"``, ``"off"``, or a value such as ``"degree 1"``."""
    evidence: str
    """A plain sentence with figures."""
    figures: dict[str, float] = field(default_factory=dict)
    """The figures of the evidence, finite."""
    measured: bool = True
    """Whether the photos were asked; false where the settings alone decide."""

    def __post_init__(self) -> None:
        if self.setting not in SELECTION_MODES:
            raise UsageError(
                f"The setting {self.name} is {self.setting!r}.",
                f"Give one of {', '.join(SELECTION_MODES)}.",
            )

    @property
    def overridden(self) -> bool:
        """Whether a person decided and not the photos."""
        return self.setting != "auto"

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; figures that are not finite are left out."""
        values = dataclasses.asdict(self)
        values["figures"] = {k: float(v) for k, v in self.figures.items() if math.isfinite(v)}
        return values

    @classmethod
    def from_json(cls, values: Any) -> Decision:
        """Build from :meth:`to_json`'s values.

        Raises
        ------
        UsageError
            An entry is missing or of the wrong type.
        """
        try:
            name, setting, chosen, evidence = texts = [
                values[entry] for entry in ("name", "setting", "chosen", "evidence")
            ]
            figures = {str(k): float(v) for k, v in values["figures"].items()}
            if not all(isinstance(text, str) for text in texts):
                raise TypeError("not text")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UsageError(
                f"A stored decision cannot be read ({error}).", "Train the scene again."
            ) from error
        measured = values.get("measured") is not False  # version 0.1.0 did not tell
        return cls(name, setting, chosen, evidence, figures, measured)


@dataclass(frozen=True)
class ModelSelection:
    """The decisions of a scene, in the order in which they were first taken; one of each name."""

    decisions: tuple[Decision, ...] = ()

    def __iter__(self) -> Iterator[Decision]:
        return iter(self.decisions)

    def __len__(self) -> int:
        return len(self.decisions)

    def get(self, name: str) -> Decision | None:
        """Return the decision of a name, or ``None`` before it was taken."""
        return next((d for d in self.decisions if d.name == name), None)

    def chose(self, name: str, value: str = ON) -> bool:
        """Tell whether a decision was taken and chose ``value``."""
        decision = self.get(name)
        return decision is not None and decision.chosen == value

    def with_decision(self, decision: Decision) -> ModelSelection:
        """Return these and one more; a later decision takes the place of one of the same name."""
        if self.get(decision.name) is None:
            return ModelSelection((*self.decisions, decision))
        return ModelSelection(
            tuple(decision if d.name == decision.name else d for d in self.decisions)
        )

    def to_json(self) -> list[dict[str, Any]]:
        """Return plain JSON values."""
        return [decision.to_json() for decision in self.decisions]

    @classmethod
    def from_json(cls, values: Any) -> ModelSelection:
        """Build from :meth:`to_json`'s values.

        Raises
        ------
        UsageError
            They are no list of decisions.
        """
        if not isinstance(values, list):
            raise UsageError("Stored decisions are no list.", "Train the scene again.")
        model_selection = cls()
        for entry in values:
            model_selection = model_selection.with_decision(Decision.from_json(entry))
        return model_selection


def decide(
    name: str, setting: str, needed: bool, evidence: str, figures: dict[str, float] | None = None
) -> Decision:
    """Return ``"on"`` where it is needed, or what the setting asks for instead of the evidence."""
    chosen = (ON if needed else OFF) if setting == "auto" else setting
    return Decision(name, setting, chosen, evidence, dict(figures or {}))


def select_multi_view(neighbours: Sequence[np.ndarray], setting: str = "auto") -> Decision:
    """Decide whether the multi-view terms are used (docs/method.md, section 3.4).

    They compare a photo with one taken from a similar place, and are on as soon as any photo has
    such a neighbour: photos without one skip them and cost nothing. Without any neighbour they stay
    off whatever was asked for, as there is nothing to compare.

    Parameters
    ----------
    neighbours : sequence of (k,) int arrays
        Of each training view, its neighbours.
    setting : str
    """
    count = len(neighbours)
    paired = sum(len(of_view) > 0 for of_view in neighbours)
    share = paired / max(1, count)
    figures = {
        "photos": float(count),
        "share_with_neighbour": share,
        "neighbours_per_photo": sum(map(len, neighbours)) / max(1, count),
    }
    if paired == 0:
        evidence = (
            f"None of the {count} photos has another one taken from a similar place and direction, "
            "so there is nothing to compare."
        )
        return Decision("multi_view", setting, OFF, evidence, figures)
    evidence = (
        f"{paired} of {count} photos ({100.0 * share:.0f} %) have another one taken from a similar "
        f"place and direction, {figures['neighbours_per_photo']:.1f} on average."
    )
    return decide("multi_view", setting, True, evidence, figures)


def select_wrapping(errors: np.ndarray, weights: np.ndarray, setting: str = "auto") -> Decision:
    """Decide whether orientation is trained and clones of opposite orientation are made.

    Behind a thin part the orientation of its Gaussians is seen from the wrong side. Such Gaussians
    disagree with the depth's normals in about half of their views, those of a solid hardly
    anywhere: the share of them on what is shown is the evidence (docs/method.md, section 4.2).

    Parameters
    ----------
    errors : (n,) float
        Mean normal error ``1 - N . n_depth`` of each Gaussian over the views, in [0, 2], after the
        orientation's first guess.
    weights : (n,) float
        How much each shows: pixels, or sums of blending weights; at least 0.

    Raises
    ------
    UsageError
        The arrays do not fit together.
    """
    if errors.shape != weights.shape or errors.ndim != 1:
        raise UsageError(
            f"Errors are {errors.shape}, weights {weights.shape}.", "Give one of each per Gaussian."
        )
    known = np.isfinite(errors) & (weights > 0)
    total = float(weights[known].sum(dtype=np.float64))
    if total <= 0.0:
        evidence = "No Gaussian is seen, so nothing can be said about thin parts."
        return decide("wrapping", setting, False, evidence)
    against = float(weights[known & (errors >= TWO_SIDED_ERROR)].sum(dtype=np.float64)) / total
    mean = float(np.average(errors[known].astype(np.float64), weights=weights[known]))
    figures = {"mean_normal_error": mean, "share_two_sided": against, "limit": WRAPPING_SHARE}
    evidence = (
        f"Of the shown surface {100.0 * against:.1f} % faces another way than its depth says, as "
        f"thin parts that are seen from behind do (limit {100.0 * WRAPPING_SHARE:.0f} %)."
    )
    return decide("wrapping", setting, against >= WRAPPING_SHARE, evidence, figures)
