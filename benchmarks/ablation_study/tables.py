# SPDX-License-Identifier: GPL-3.0-or-later
"""The tables of the ablation: cells with mean and spread, and what each part changes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from ..speed_error.tables import AT, SHARES, Row, table_of
from ..study.case import Case, options
from ..study.figures import (
    MBR_NOTE,
    f1_fine,
    f1_middle,
    f1_seen,
    gaussians,
    mbr_psnr,
    normal_error,
    thin,
    view_psnr,
)
from ..study.record import Record
from ..study.spread import CLEAR, Spread, shown
from ..tables import Table
from .plan import CELLS, CLONES, OFF, ON, ORIENTED, PLAIN, SCENES, SEEDS, Cell

Records = Mapping[str, Record]
"""By identity."""
Figure = Callable[[Record], float | None]


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of the method: cells without it, each with the cell that has it besides."""

    name: str
    pairs: tuple[tuple[Cell, Cell], ...]


def _part(name: str, *pairs: tuple[tuple[str, str], tuple[str, str]]) -> Part:
    return Part(name, tuple((Cell(*without), Cell(*with_it)) for without, with_it in pairs))


PARTS = (
    _part(
        "multi-view terms", *(((OFF, level), (ON, level)) for level in (PLAIN, ORIENTED, CLONES))
    ),
    _part("orientation loss", *(((views, PLAIN), (views, ORIENTED)) for views in (OFF, ON))),
    _part("clones", *(((views, ORIENTED), (views, CLONES)) for views in (OFF, ON))),
)
"""What is added, and to what."""

FIGURES: tuple[tuple[str, Figure, int, bool], ...] = (
    (f"F1 {AT}", f1_middle, 3, True),
    (f"F1 {SHARES[0]}", f1_fine, 3, True),
    (f"thin recall {AT}", thin, 3, True),
    ("normal error", normal_error, 3, False),
    ("MBR dB", mbr_psnr, 2, True),
    ("test views dB", view_psnr, 2, True),
)
"""Heading, figure, digits, and whether more is better."""


def of_cell(records: Records, cell: Cell, scene: str) -> list[Record]:
    """Return the runs of a cell on a scene, by seed."""
    found = (records.get(cell.case(scene, seed).identity) for seed in SEEDS)
    return [record for record in found if record is not None]


def cell_table(records: Records) -> Table:
    """Return mean and standard deviation of every cell."""
    rows: list[Row] = []
    measured = _measured(records)
    for scene in SCENES:
        for cell in CELLS:
            same = of_cell(records, cell, scene)
            if not same:
                continue
            rows.append(
                {
                    "scene": scene,
                    "multi-view": cell.multi_view,
                    "wrapping": cell.label,
                    "seeds": len(same),
                    **{n: shown([f(r) for r in same], digits) for n, f, digits, _ in measured},
                    f"seen F1 {AT}": shown([f1_seen(r) for r in same], 3),
                    "Gaussians": shown([gaussians(r) for r in same], 0),
                    "training, processor s": shown([r.processor("train") for r in same], 0),
                    "closed": _closed(same),
                }
            )
    return table_of(
        "Every cell",
        rows,
        "Mean ± standard deviation over the seeds; no deviation: one seed. F1 at shares of the "
        "crop volume's diagonal, whole surface; seen F1: what the cameras see of both surfaces. "
        "Thin recall: true samples on parts thinner than 1.5 % of the diagonal that at least two "
        "cameras see, where at least 1 % of the samples are thin. Normal error: one less the mean "
        "size of the cosine between normals of counterparts, both directions. Test views: PSNR of "
        "the Gaussians at eight views that training was never given, whole photo."
        + (f" {MBR_NOTE}" if _knows_mbr(measured) else ""),
    )


def part_table(records: Records) -> Table:
    """Return what each part changes: means over pairs of runs that differ by it alone."""
    rows: list[Row] = []
    measured = _measured(records)
    several = len({r.case.seed for r in records.values()}) > 1
    for scene in (*SCENES, ""):
        for part in PARTS:
            row: Row = {"scene": scene or "all", "added": part.name}
            counts = set()
            for name, figure, digits, more in measured:
                found = differences(records, part, figure, scene)
                counts.add(len(found))
                spread = Spread.of(found)
                row[name] = None if spread is None else _judged(spread, digits, more, several)
            if max(counts) > 0:
                rows.append({**row, "pairs": max(counts)})
    return table_of(
        "What each part changes",
        rows,
        "Mean ± standard deviation of the differences between two runs of the same scene and seed "
        "that differ by this part alone. **Bold** with “better” or “worse”: the mean is more than "
        f"{CLEAR:g} standard errors from 0; all other differences say nothing. Nothing is judged "
        "before there are two seeds. Pairs of one seed share its randomness: with so few seeds the "
        "spread is somewhat too narrow.",
    )


def differences(records: Records, part: Part, figure: Figure, scene: str = "") -> list[float]:
    """Return the figure with a part less without it, for every pair of runs (of a scene)."""
    found = []
    for name in SCENES if not scene else (scene,):
        for without, with_it in part.pairs:
            for seed in SEEDS:
                pair = [records.get(c.case(name, seed).identity) for c in (without, with_it)]
                values = [None if r is None else figure(r) for r in pair]
                if values[0] is not None and values[1] is not None:
                    found.append(values[1] - values[0])
    return found


def settings_table(cases: Sequence[Case]) -> Table:
    """Return what distinguishes the cells, from the arguments of their runs."""
    given = {case.name: options(case.arguments) for case in cases}
    names = list(dict.fromkeys(option for values in given.values() for option in values))
    varied = [n for n in names if len({values.get(n) for values in given.values()}) > 1]
    rows: list[Row] = [
        {
            "multi-view": cell.multi_view,
            "wrapping": cell.label,
            **{f"`{n}`": given[cell.name].get(n) for n in varied},
        }
        for cell in CELLS
        if cell.name in given
    ]
    return table_of("What is varied", rows)


def fixed_options(cases: Sequence[Case]) -> dict[str, str]:
    """Return the options that all runs share, with their values."""
    given = [options(case.arguments) for case in cases]
    return {n: v for n, v in given[0].items() if all(values.get(n) == v for values in given)}


def _measured(records: Records) -> list[tuple[str, Figure, int, bool]]:
    """Return the figures that at least one run has."""
    return [f for f in FIGURES if any(f[1](r) is not None for r in records.values())]


def _knows_mbr(measured: Sequence[tuple[str, Figure, int, bool]]) -> bool:
    return any(figure is mbr_psnr for _, figure, _, _ in measured)


def _judged(spread: Spread, digits: int, more_is_better: bool, several_seeds: bool) -> str:
    text = spread.text(digits, signed=True)
    if not (several_seeds and spread.clear):
        return text
    better = (spread.mean > 0) == more_is_better
    return f"**{text} {'better' if better else 'worse'}**"


def _closed(records: Sequence[Record]) -> str:
    open_ones = sum(not r.mesh["closed"] for r in records)
    return "yes" if open_ones == 0 else f"NO ({open_ones} of {len(records)})"
