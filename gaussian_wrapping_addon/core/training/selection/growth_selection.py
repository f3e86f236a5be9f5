# SPDX-License-Identifier: GPL-3.0-or-later
"""When more Gaussians stop paying: the fall of the error against the growth of their number."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .model_selection import Decision

MIN_GAIN_DB = 0.2
"""Growth stops where twice the Gaussians would lower the error of the trained photos by less than
this. Twice the Gaussians cost up to twice the time. Gains of growth fall with each doubling; where
each brings about half of the one before, all that would still come is no more than this again."""

MIN_GROWTH = 1.15
"""Two visits of a photo are compared where Gaussians have become this many times as many in
between: below, the noise of single visits divided by the growth says nothing."""

MAX_GROWTH = 3.0
"""And no older visit than that, so that early gains do not speak for late ones."""

MIN_VIEWS = 5
"""No decision from fewer photos that were visited before and after."""

CERTAINTY = 2.0
"""Standard errors that must lie between the gain and :data:`MIN_GAIN_DB`. Growth is asked about
after every round and stops for good: with one, a scene of 40 photos stopped by chance at 36 000 of
80 000 Gaussians and lost 3.5 dB on photos that were kept back."""

CAPACITY = 32_768
"""Visits that are remembered; older ones are forgotten."""

_COLUMNS = 5
_SPREAD_OF_MAD = 1.4826
_ERROR_FLOOR = 1e-10


@dataclass(frozen=True)
class GrowthEvidence:
    """Whether growth pays at a moment."""

    pays: bool
    """Also where it is not known yet: only evidence stops growth."""
    known: bool
    gain_db: float
    """Median over the photos: fall of the error per doubling of the Gaussians; NaN if unknown."""
    spread_db: float
    """Standard error of that median; NaN if unknown."""
    views: int
    """Photos that it is the median of."""
    gaussians: int
    iteration: int

    def decision(self, setting: str = "auto") -> Decision:
        """Return the record: ``"stopped"``, ``"to the cap"`` or ``"none added"``."""
        chosen = {
            "auto": "to the cap" if self.pays else "stopped",
            "on": "to the cap",
            "off": "none added",
        }.get(setting, "")
        figures = {"gaussians": float(self.gaussians), "iteration": float(self.iteration)}
        if not self.known:
            evidence = "Too few parts of photos were seen again after the Gaussians grew in number."
            return Decision("growth", setting, chosen, evidence, figures)
        evidence = (
            f"At iteration {self.iteration}, with {self.gaussians} Gaussians, twice as many would "
            f"have lowered the error by about {self.gain_db:.2f} dB (± {self.spread_db:.2f}, from "
            f"{self.views} photos; worth it from {MIN_GAIN_DB:.1f} dB)."
        )
        figures |= {
            "gain_db": self.gain_db,
            "spread_db": self.spread_db,
            "views": float(self.views),
            "limit_db": MIN_GAIN_DB,
        }
        return Decision("growth", setting, chosen, evidence, figures)


class ErrorHistory:
    """The errors of the trained photos, visit by visit; part of a training's state."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, int, float, int]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(
        self, iteration: int, view: int, gaussians: int, mean_squared: float, divisor: int
    ) -> None:
        """Remember one iteration.

        Parameters
        ----------
        iteration, view, gaussians : int
        mean_squared : float
            Mean squared colour error of the photo, before the step.
        divisor : int
            Of the pyramid's level: only visits at the same size are compared.
        """
        self._rows.append((iteration, view, gaussians, mean_squared, divisor))
        if len(self._rows) > CAPACITY:
            del self._rows[: len(self._rows) - CAPACITY]

    def clear(self) -> None:
        """Forget all visits, as after an opacity reset."""
        self._rows.clear()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return all that is remembered, by name."""
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
        """Return whether more Gaussians still pay.

        The last visit of each photo is compared with the latest earlier one that had fewer
        Gaussians by :data:`MIN_GROWTH`, at the same image size: photos differ in error several
        times over, and only a comparison of each with itself is not drowned by that. The median
        over the photos is not moved by single bad ones. What training itself has gained between the
        visits counts for the growth, so the decision errs towards growing on; it stops only where
        the median lies below :data:`MIN_GAIN_DB` by :data:`CERTAINTY` standard errors. Errors that
        rise say nothing about growth: another term of the loss began, or Gaussians were removed.
        """
        iteration, _, gaussians, _, _ = self._rows[-1] if self._rows else (0, 0, 0, 0.0, 1)
        gains = np.array(list(self._gains()))
        nan = math.nan
        if len(gains) < MIN_VIEWS:
            return GrowthEvidence(True, False, nan, nan, len(gains), gaussians, iteration)
        median = float(np.median(gains))
        # Of a median of normally spread values: 1.2533 times that of a mean.
        spread = _SPREAD_OF_MAD * float(np.median(np.abs(gains - median)))
        spread *= 1.2533 / math.sqrt(len(gains))
        if median + CERTAINTY * spread < -MIN_GAIN_DB:  # something else made the errors rise
            return GrowthEvidence(True, False, nan, nan, len(gains), gaussians, iteration)
        pays = median + CERTAINTY * spread >= MIN_GAIN_DB
        return GrowthEvidence(pays, True, median, spread, len(gains), gaussians, iteration)

    def _gains(self) -> Iterator[float]:
        """Yield dB per doubling of each photo that can be compared."""
        by_view: dict[int, list[tuple[int, int, int, float, int]]] = {}
        for row in self._rows:
            by_view.setdefault(row[1], []).append(row)
        for view in sorted(by_view):
            errors = by_view[view]
            _, _, now, error, divisor = errors[-1]
            # A photo not seen at the current size says nothing about the present.
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
