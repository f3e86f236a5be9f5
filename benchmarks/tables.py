# SPDX-License-Identifier: GPL-3.0-or-later
"""Tables of figures as Markdown: thresholds, cells, rows, and spread over seeds.

A row is a dictionary from column to value, so that a heading cannot stand over another figure.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Sequence
from typing import Any

from gaussian_wrapping_addon.core.evaluation.surface_scores import MIN_THIN_SHARE

from .runs import THRESHOLD_SHARES

Cell = str | float | int | None


@dataclasses.dataclass(frozen=True)
class Table:
    """One table under a heading, with notes below it."""

    title: str
    header: tuple[str, ...]
    rows: list[tuple[Cell, ...]]
    notes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """Return the table with columns of equal width."""
        cells = [[_text(cell) for cell in row] for row in self.rows]
        widths = [max(len(line[i]) for line in [list(self.header), *cells]) for i in _range(self)]
        words = [
            all(isinstance(row[i], str) or row[i] is None for row in self.rows)
            for i in _range(self)
        ]

        def line(values: list[str]) -> str:
            padded = [
                value.ljust(width) if left else value.rjust(width)
                for value, width, left in zip(values, widths, words, strict=True)
            ]
            return f"| {' | '.join(padded)} |"

        rule = "|".join(
            f":{'-' * (width + 1)}" if left else f"{'-' * (width + 1)}:"
            for width, left in zip(widths, words, strict=True)
        )
        lines = [f"### {self.title}", "", line(list(self.header)), f"|{rule}|"]
        lines += [line(row) for row in cells]
        for note in self.notes:
            lines += ["", note]
        return "\n".join(lines) + "\n"


def _range(table: Table) -> range:
    return range(len(table.header))


def _text(cell: Cell) -> str:
    if cell is None:
        return ""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, int):
        return f"{cell}"
    if not math.isfinite(cell):
        return str(cell)
    if cell == 0.0:
        return "0"
    if abs(cell) < 0.01 or abs(cell) >= 1e5:
        return f"{cell:.1e}"
    return f"{cell:.1f}" if abs(cell) >= 20.0 else f"{cell:.2f}"


SHARES = tuple(f"{100 * share:g} %" for share in THRESHOLD_SHARES)
MIDDLE = 1
"""The threshold that is shown where there is room for one: 0.5 %."""
AT = SHARES[MIDDLE]

Row = dict[str, Cell]


def table_of(title: str, rows: Sequence[Row], *notes: str) -> Table:
    """Return a table whose columns are the keys of its rows, without those of no value at all."""
    header = [name for name in (rows[0] if rows else ()) if any(r[name] is not None for r in rows)]
    return Table(title, tuple(header), [tuple(row[name] for name in header) for row in rows], notes)


def thin_recall(surface: dict[str, Any]) -> float | None:
    """Return the recall of thin parts, or ``None`` where there are practically none."""
    few = surface["thin_count"] < MIN_THIN_SHARE * surface["truth_count"]
    return None if few or surface["thin_recall"] is None else surface["thin_recall"][MIDDLE]


def missing_table(missing: Sequence[tuple[str, str]]) -> Table:
    """Return runs that were planned and have no figures."""
    rows: list[Row] = [
        {"run": name, "reason": reason.replace("|", "/")} for name, reason in missing
    ]
    return table_of("Not measured", rows)


def two(value: float | None) -> str | None:
    """Return a figure with two decimals; an empty cell where it was not measured."""
    return None if value is None else f"{value:.2f}"


def three(value: float | None) -> str | None:
    """Return a figure with three decimals; an empty cell where it was not measured."""
    return None if value is None else f"{value:.3f}"


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
