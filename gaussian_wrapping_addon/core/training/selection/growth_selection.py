# SPDX-License-Identifier: GPL-3.0-or-later
"""Decide when to stop densification: error reduction per doubling of the Gaussians."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .model_selection import Decision

MIN_GAIN_DB = 0.2
"""Growth stops if twice the Gaussians would lower the error of the training photos by less than
this. Twice the Gaussians cost up to twice the time. Gains fall with each doubling; if each is about
half of the one before, all further gains add up to no more than this again."""

MIN_GROWTH = 1.15
"""Least growth of the number of Gaussians between two compared errors of a photo: below it, the
noise of single errors dominates the gain per doubling."""

MAX_GROWTH = 3.0
"""Largest such growth: older errors are ignored, as early gains do not predict late ones."""

MIN_VIEWS = 5
"""Fewest photos with errors before and after the growth for a decision."""

CERTAINTY = 2.0
"""Standard errors required between the gain and :data:`MIN_GAIN_DB`. Growth is tested after every
densification and stops for good: with one standard error, a scene of 40 photos stopped by chance at
36 000 of 80 000 Gaussians and lost 3.5 dB on held-out photos."""

CAPACITY = 32_768
"""Entries kept; older ones are dropped."""

_COLUMNS = 5
_SPREAD_OF_MAD = 1.4826
_ERROR_FLOOR = 1e-10


@dataclass(frozen=True)
class GrowthEvidence:
    """Estimate of whether growth still pays."""

    pays: bool
    """True also if not known yet: only evidence stops growth."""
    known: bool
    gain_db: float
    """Median over the photos of the error reduction per doubling; NaN if unknown."""
    spread_db: float
    """Standard error of that median; NaN if unknown."""
    views: int
    """Number of photos in the median."""
    gaussians: int
    iteration: int

    def decision(self, setting: str = "auto") -> Decision:
        """Return the decision: ``"stopped"``, ``"to the cap"`` or ``"none added"``."""
        chosen = {
            "auto": "to the cap" if self.pays else "stopped",
            "on": "to the cap",
            "off": "none added",
        }.get(setting, "")
        figures = {"gaussians": float(self.gaussians), "iteration": float(self.iteration)}
        if not self.known:
            evidence = "Too few photos were rendered before and after the Gaussians grew in number."
            return Decision("growth", setting, chosen, evidence, figures)
        evidence = (
            f"At iteration {self.iteration}, with {self.gaussians} Gaussians, twice as many would "
            f"have lowered the error by about {self.gain_db:.2f} dB (± {self.spread_db:.2f}, from "
            f"{self.views} photos; threshold {MIN_GAIN_DB:.1f} dB)."
        )
        figures |= {
            "gain_db": self.gain_db,
            "spread_db": self.spread_db,
            "views": float(self.views),
            "limit_db": MIN_GAIN_DB,
        }
        return Decision("growth", setting, chosen, evidence, figures)


class ErrorHistory:
    """Colour errors of the training photos by iteration; part of the training state."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, int, float, int]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(
        self, iteration: int, view: int, gaussians: int, mean_squared: float, divisor: int
    ) -> None:
        """Record one iteration.

        Parameters
        ----------
        iteration, view, gaussians : int
        mean_squared : float
            Mean squared colour error of the photo, before the step.
        divisor : int
            Divisor of the image size: only errors at the same size are compared.
        """
        self._rows.append((iteration, view, gaussians, mean_squared, divisor))
        if len(self._rows) > CAPACITY:
            del self._rows[: len(self._rows) - CAPACITY]

    def clear(self) -> None:
        """Drop all entries, as after an opacity reset."""
        self._rows.clear()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return all entries, by name; the key ``visits`` is that of checkpoints."""
        return {"visits": np.array(self._rows, np.float64).reshape(-1, _COLUMNS)}

    @classmethod
    def restore(cls, arrays: dict[str, np.ndarray]) -> ErrorHistory:
        """Build from :meth:`to_arrays`.

        Raises
        ------
        KeyError, ValueError
            The array is missing or has another shape.
        """
        errors = arrays["visits"]
        if errors.ndim != 2 or errors.shape[1] != _COLUMNS:
            raise ValueError(f"visits are {errors.shape}")
        history = cls()
        for row in errors.tolist():
            history.add(int(row[0]), int(row[1]), int(row[2]), row[3], int(row[4]))
        return history

    def growth_evidence(self) -> GrowthEvidence:
        """Estimate whether more Gaussians still pay.

        The last error of each photo is compared with its latest earlier one at which there were
        fewer Gaussians by :data:`MIN_GROWTH`, at the same image size: errors differ several times
        over between photos, so that each photo is compared with itself only. The median over the
        photos is robust against outliers. Gains of training itself between the two errors count as
        gains of growth, so the decision errs towards further growth; it stops only if the median
        lies below :data:`MIN_GAIN_DB` by :data:`CERTAINTY` standard errors. Rising errors say
        nothing about growth: another loss term started, or Gaussians were removed.
        """
        iteration, _, gaussians, _, _ = self._rows[-1] if self._rows else (0, 0, 0, 0.0, 1)
        gains = np.array(list(self._gains()))
        nan = math.nan
        if len(gains) < MIN_VIEWS:
            return GrowthEvidence(True, False, nan, nan, len(gains), gaussians, iteration)
        median = float(np.median(gains))
        # The standard error of a median is 1.2533 times that of a mean, for normal values.
        spread = _SPREAD_OF_MAD * float(np.median(np.abs(gains - median)))
        spread *= 1.2533 / math.sqrt(len(gains))
        if median + CERTAINTY * spread < -MIN_GAIN_DB:  # errors rose for other reasons
            return GrowthEvidence(True, False, nan, nan, len(gains), gaussians, iteration)
        pays = median + CERTAINTY * spread >= MIN_GAIN_DB
        return GrowthEvidence(pays, True, median, spread, len(gains), gaussians, iteration)

    def _gains(self) -> Iterator[float]:
        """Yield the gain of each comparable photo, dB per doubling."""
        by_view: dict[int, list[tuple[int, int, int, float, int]]] = {}
        for row in self._rows:
            by_view.setdefault(row[1], []).append(row)
        for view in sorted(by_view):
            errors = by_view[view]
            _, _, now, error, divisor = errors[-1]
            # Skip photos not rendered at the current image size.
            if divisor != self._rows[-1][4]:
                continue
            for _, _, then, before, size in reversed(errors[:-1]):
                growth = now / max(1, then)
                if size != divisor or growth > MAX_GROWTH:
                    break
                if growth >= MIN_GROWTH:
                    ratio = max(before, _ERROR_FLOOR) / max(error, _ERROR_FLOOR)
                    yield 10.0 * math.log10(ratio) / math.log2(growth)
                    break
