# SPDX-License-Identifier: GPL-3.0-or-later
"""Model selection: records of decisions, camera poses."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import UsageError
from ..scene.camera import Camera
from ..scene.scene import Scene
from ..settings import SELECTION_MODES
from .camera_poses import LEAST_VIEWS, CameraPoses

# -- Decisions of the model selection, their evidence, and the criteria that need no rendering ----
#
# docs/method.md, section 4.4: more model than needed costs time and invites error, so each part
# of the model is enabled by evidence from the photos, records that evidence, and can be
# overridden by a setting.

ON, OFF = "on", "off"


@dataclass(frozen=True)
class Decision:
    """One decision of the model selection with its evidence."""

    name: str
    """Name; that of the :class:`~.settings.TrainingSettings` field if there is one."""
    setting: str
    """Requested value: ``"auto"``, ``"on"`` or ``"off"``."""
    chosen: str
    """Chosen value: ``"on"``, ``"off"``, or for instance ``"degree 1"``."""
    evidence: str
    """One sentence with figures, for the report."""
    figures: dict[str, float] = field(default_factory=dict)
    """The figures of the evidence, finite."""
    measured: bool = True
    """Whether the photos were measured; false if the settings alone decide."""

    def __post_init__(self) -> None:
        if self.setting not in SELECTION_MODES:
            raise UsageError(
                f"The setting {self.name} is {self.setting!r}.",
                f"Give one of {', '.join(SELECTION_MODES)}.",
            )

    @classmethod
    def by_settings(cls, name: str, word: str) -> Decision:
        """Return the decision that a setting of ``"on"`` or ``"off"`` takes."""
        return cls(name, word, word, "Not measured: decided by the settings.", measured=False)

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
            An entry is missing or has the wrong type.
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
        measured = values.get("measured") is not False  # not stored by version 0.1.0
        return cls(name, setting, chosen, evidence, figures, measured)


@dataclass(frozen=True)
class ModelSelection:
    """Decisions for a scene, in the order in which they were first taken; one per name."""

    decisions: tuple[Decision, ...] = ()

    def __iter__(self) -> Iterator[Decision]:
        return iter(self.decisions)

    def __len__(self) -> int:
        return len(self.decisions)

    def get(self, name: str) -> Decision | None:
        """Return the decision with a name, or ``None`` if not taken yet."""
        return next((d for d in self.decisions if d.name == name), None)

    def chose(self, name: str, value: str = ON) -> bool:
        """Tell whether the decision was taken and its choice is ``value``."""
        decision = self.get(name)
        return decision is not None and decision.chosen == value

    def with_decision(self, decision: Decision) -> ModelSelection:
        """Return a copy with a decision added; it replaces one of the same name."""
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
            ``values`` is not a list of decisions.
        """
        if not isinstance(values, list):
            raise UsageError("Stored decisions are not a list.", "Train the scene again.")
        model_selection = cls()
        for entry in values:
            model_selection = model_selection.with_decision(Decision.from_json(entry))
        return model_selection


def decide(
    name: str, setting: str, needed: bool, evidence: str, figures: dict[str, float] | None = None
) -> Decision:
    """Decide ``"on"`` or ``"off"`` by the evidence, unless the setting overrides it."""
    chosen = (ON if needed else OFF) if setting == "auto" else setting
    return Decision(name, setting, chosen, evidence, dict(figures or {}))


def select_multi_view(neighbours: Sequence[np.ndarray], setting: str = "auto") -> Decision:
    """Decide whether the multi-view terms are used (docs/method.md, section 3.4).

    They compare a photo with one taken from a nearby pose, and are on if any of the training views
    has ``neighbours``: photos without one skip them at no cost. Without any neighbour they stay
    off, whatever the setting, as there is nothing to compare.
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
            f"None of the {count} photos has a neighbour taken from a similar position and "
            "direction, so there is nothing to compare."
        )
        return Decision("multi_view", setting, OFF, evidence, figures)
    evidence = (
        f"{paired} of {count} photos ({100.0 * share:.0f} %) have neighbours taken from a similar "
        f"position and direction, {figures['neighbours_per_photo']:.1f} on average."
    )
    return decide("multi_view", setting, True, evidence, figures)


# -- Whether camera poses are refined (docs/method.md, section 1.8) -------------------------------

LEAST_SHIFT_PX = 0.25
"""Median shift from which given poses count as inexact. Noise alone moves exact ones by 0.12."""


def start_poses(
    setting: str, scene: Scene, views: Sequence[int], model_selection: ModelSelection
) -> tuple[CameraPoses | None, ModelSelection]:
    """Return poses to refine, if any, and the decisions with this one where nothing is to measure.

    The setting ``"auto"`` refines them only after a dense start: from sparse points Gaussians are
    in the wrong places at first, and cameras would follow them.
    """
    missing = ""
    if len(views) < LEAST_VIEWS:
        missing = f"Not tried: fewer than {LEAST_VIEWS} photos to train on."
    elif setting == "auto" and not model_selection.chose("dense_start"):
        missing = "Not tried: training did not start on surfaces found by matching photos."
    if setting == "off":
        return None, model_selection.with_decision(Decision.by_settings("refine_poses", "off"))
    if missing:
        decision = Decision("refine_poses", setting, "off", missing, measured=False)
        return None, model_selection.with_decision(decision)
    given = np.array([view.camera.cam_from_world for view in scene.views], np.float64)
    if setting == "on":
        model_selection = model_selection.with_decision(Decision.by_settings("refine_poses", "on"))
    return CameraPoses(given, views), model_selection


def select_poses(poses: CameraPoses, cameras: Mapping[int, Camera], means: np.ndarray) -> Decision:
    """Decide whether refined poses differ from those given, and give them up if not.

    Poses that photos move at random only are better as they were: what moves them is noise.
    ``cameras`` are the training photos', ``means`` (n, 3) the Gaussians', scene frame.
    """
    shift_px = float(np.median(poses.shifts_px(cameras, means)))
    needed = shift_px >= LEAST_SHIFT_PX
    if not needed:
        poses.give_up()
    evidence = (
        f"Photos move half of the cameras by {shift_px:.2f} px or more "
        f"(needed: {LEAST_SHIFT_PX:g} px)."
    )
    return decide("refine_poses", "auto", needed, evidence, {"shift_px": shift_px})
