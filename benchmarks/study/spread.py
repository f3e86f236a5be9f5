# SPDX-License-Identifier: GPL-3.0-or-later
"""Mean, spread and paired differences over seeds."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Sequence

CLEAR = 2.0
"""A mean difference counts as clear from so many of its standard errors."""


@dataclasses.dataclass(frozen=True)
class Spread:
    """Mean of a figure over runs that differ by their seed."""

    mean: float
    deviation: float | None
    """Of the sample; ``None`` for a single value."""
    count: int

    @staticmethod
    def of(values: Sequence[float]) -> Spread | None:
        """Return mean and spread, ``None`` without values."""
        if not values:
            return None
        deviation = statistics.stdev(values) if len(values) > 1 else None
        return Spread(statistics.fmean(values), deviation, len(values))

    @property
    def error(self) -> float | None:
        """Standard error of the mean."""
        return None if self.deviation is None else self.deviation / math.sqrt(self.count)

    @property
    def clear(self) -> bool:
        """Tell whether the mean differs from 0 by more than chance; never of a single value."""
        return self.error is not None and abs(self.mean) > CLEAR * self.error

    def text(self, digits: int, *, signed: bool = False) -> str:
        """Return ``mean ± deviation``, or the value alone."""
        mean = f"{self.mean:{'+' if signed else ''}.{digits}f}"
        return mean if self.deviation is None else f"{mean} ± {self.deviation:.{digits}f}"


def shown(values: Sequence[float | None], digits: int) -> str | None:
    """Return mean and spread of the values that are known; an empty cell without any."""
    spread = Spread.of([v for v in values if v is not None])
    return None if spread is None else spread.text(digits)
