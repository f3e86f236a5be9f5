# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of a setting's value: numeric ranges, choices, subsets and other conditions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol


class Check(Protocol):
    """Condition that a setting's value must fulfil, with a description of valid values."""

    @property
    def wanted(self) -> str:
        """Description of valid values, for the sentence "Give <wanted>."."""

    def holds(self, value: Any) -> bool:
        """Tell whether a value is valid."""


@dataclass(frozen=True)
class Range:
    """A finite number from ``low`` to ``high``."""

    low: float
    high: float = math.inf
    zero: str = ""
    """Meaning of 0, if it is allowed in addition to the range."""
    words: str = ""
    """Replaces the generated description."""
    below_high: bool = False
    """Whether ``high`` itself is excluded."""

    @property
    def wanted(self) -> str:
        if self.words:
            return self.words
        to = "to below" if self.below_high else "to"
        span = f"from {_plain(self.low)} {to} {_plain(self.high)}"
        return f"0 ({self.zero}) or {span}" if self.zero else span

    @property
    def lowest(self) -> float:
        """The smallest valid value, 0 if it has a meaning of its own."""
        return 0 if self.zero else self.low

    def holds(self, value: Any) -> bool:
        if self.zero and value == 0:
            return True
        if value == math.inf or (self.below_high and value >= self.high):
            return False
        return bool(self.low <= value <= self.high)


@dataclass(frozen=True)
class Choices:
    """One of a list of words or numbers."""

    values: tuple[Any, ...]

    @property
    def wanted(self) -> str:
        return f"one of {', '.join(map(str, self.values))}"

    def holds(self, value: Any) -> bool:
        return value in self.values


@dataclass(frozen=True)
class Subset:
    """Any number of words of a list."""

    values: tuple[str, ...]

    @property
    def wanted(self) -> str:
        return f"among {', '.join(self.values)}"

    def holds(self, value: Any) -> bool:
        return set(value) <= set(self.values)


@dataclass(frozen=True)
class Condition:
    """Any value that a function accepts."""

    accepts: Callable[[Any], bool]
    wanted: str

    def holds(self, value: Any) -> bool:
        return self.accepts(value)


def _plain(number: float) -> str:
    return str(int(number)) if float(number).is_integer() else str(number)
