# SPDX-License-Identifier: GPL-3.0-or-later
"""Text formatting for reports: numbers with units, durations, escaped Markdown, tables, bars."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

NOT_MEASURED = "not measured"

BAR_CHARACTERS = 24
_MARKUP = str.maketrans(
    {c: f"\\{c}" for c in "\\`*_[]#~|"} | {"<": "&lt;", ">": "&gt;", "&": "&amp;"}
)


def part(values: Any, *keys: str) -> dict[str, Any]:
    """Return a nested dictionary; empty if a key is missing or not a dictionary."""
    for key in keys:
        values = values.get(key) if isinstance(values, dict) else None
    return values if isinstance(values, dict) else {}


def items(values: Any) -> list[Any]:
    """Return a list unchanged, anything else as an empty list."""
    return values if isinstance(values, list) else []


def measured(value: Any) -> float | None:
    """Return a finite number, or ``None`` for anything else, including booleans and NaN."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def number(value: Any, unit: str = "", *, digits: int | None = None) -> str:
    """Return a number with its unit, or :data:`NOT_MEASURED`.

    Parameters
    ----------
    value : any
        Value of a report; only finite numbers count as measured.
    unit : str
    digits : int, optional
        Digits after the decimal point; by default, integers are written in full and other
        numbers with four significant digits.
    """
    found = measured(value)
    if found is None:
        return NOT_MEASURED
    if digits is not None:
        text = f"{found:,.{digits}f}"
    elif found == int(found) and abs(found) < 1e15:
        text = f"{int(found):,}"
    else:
        text = f"{found:,.4g}" if 1e-3 <= abs(found) < 1e4 else f"{found:.3e}"
        if 1e4 <= abs(found) < 1e9:
            text = f"{found:,.0f}"
    return f"{text} {unit}" if unit else text


def plural(count: Any, one: str, many: str = "") -> str:
    """Return a count with its noun, as ``1 photo`` or ``3 photos``."""
    return number(count, one if count == 1 else many or one + "s")


def percent(value: Any, digits: int = 1) -> str:
    """Return a share as a percentage; 0 % and 100 % only if exact."""
    share = measured(value)
    if share is None:
        return NOT_MEASURED
    text = f"{100.0 * share:.{digits}f}"
    step = 10.0**-digits
    if share > 0.0 and float(text) == 0.0:
        return f"less than {step:g} %"
    if share < 1.0 and float(text) >= 100.0:
        return f"{100.0 - step:.{digits}f} %"
    return f"{text} %"


def duration(seconds: Any) -> str:
    """Return a duration in seconds, minutes or hours."""
    found = measured(seconds)
    if found is None:
        return NOT_MEASURED
    whole = max(0, round(found))
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 10:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(minutes + (rest >= 30), 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"


def bytes_text(value: Any) -> str:
    """Return bytes as MiB or GiB."""
    found = measured(value)
    if found is None or found <= 0:
        return NOT_MEASURED
    return f"{found / 2**30:.2f} GiB" if found >= 2**30 else f"{found / 2**20:.0f} MiB"


def escaped(text: Any) -> str:
    """Escape text for Markdown, on one line, valid inside a table."""
    return " ".join(str(text).split()).translate(_MARKUP)


def escaped_or(value: Any, default: str = "unknown") -> str:
    """Return escaped text, or ``default`` if it is missing or empty."""
    return default if value is None or value == "" else escaped(value)


def bar(share: float) -> str:
    """Return a text bar for a share in [0, 1]; any share above 0 is visible."""
    full = max(0.0, min(1.0, share)) * BAR_CHARACTERS
    count = max(1, round(full)) if share > 0 else 0
    return "█" * count + "░" * (BAR_CHARACTERS - count)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], align: str) -> list[str]:
    """Return the lines of a Markdown table.

    Parameters
    ----------
    header : sequence of str
    rows : sequence of sequences of str
        Cells as Markdown; text from outside must already be :func:`escaped`.
    align : str
        One of ``l`` and ``r`` for each column.
    """
    marks = {"l": "---", "r": "---:"}
    lines = [header, [marks[a] for a in align], *rows]
    for row in lines:
        if len(row) != len(align):
            raise ValueError(f"a row of {len(row)} cells in a table of {len(align)} columns")
    return [f"| {' | '.join(row)} |" for row in lines]
