# SPDX-License-Identifier: GPL-3.0-or-later
"""What tables of figures share: thresholds, cells, rows.

A row is a dictionary from column to value, so that a heading cannot stand over another figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gaussian_wrapping_addon.core.evaluation.surface.scores import MIN_THIN_SHARE

from ..tables import Cell, Table
from .plan import THRESHOLD_SHARES

SHARES = tuple(f"{100 * share:g} %" for share in THRESHOLD_SHARES)
MIDDLE = 1
"""The threshold that is shown where there is room for one: 0.5 %."""
AT = SHARES[MIDDLE]

Row = dict[str, Cell]


def table_of(title: str, rows: Sequence[Row], *notes: str) -> Table:
    """Return a table whose columns are the keys of its rows."""
    header = tuple(rows[0]) if rows else ()
    return Table(title, header, [tuple(row[name] for name in header) for row in rows], notes)


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
