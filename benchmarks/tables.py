# SPDX-License-Identifier: GPL-3.0-or-later
"""Tables of a benchmark, as Markdown that is also readable in a terminal."""

from __future__ import annotations

import dataclasses
import math
import platform
from importlib import metadata

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


def versions() -> str:
    """Return the versions of what the figures depend on."""
    packages = ("numpy", "numba", "llvmlite", "torch")
    return ", ".join(
        [f"Python {platform.python_version()}", *(f"{p} {metadata.version(p)}" for p in packages)]
    )
