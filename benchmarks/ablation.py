# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure what multi-view terms, orientation and clones gain: ``python -m benchmarks.ablation``.

Every run is a job through the command line on photos of a scene whose surface is known exactly
(``benchmarks/scenes``), with three seeds. Each leaves a record in ``benchmarks/records/ablation``;
a run that has one is not made again, so that the study may take several sittings: stop the command
whenever you like. At the end, or with ``--document``, ``docs/benchmarks/ablation.md`` and its plot
are written from the records alone.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from .plots import Panel, Series, write_svg
from .provenance import write_page
from .study import (
    MBR_NOTE,
    PHOTOS,
    Case,
    Record,
    commits,
    f1_fine,
    f1_middle,
    f1_seen,
    gaussians,
    made_by,
    mbr_psnr,
    normal_error,
    options,
    photos_said,
    reading,
    run_study,
    thin,
    view_psnr,
)
from .tables import AT, CLEAR, SHARES, Row, Spread, Table, shown, table_of

STUDY = "ablation"
SCENES = ("wheel", "spot", "fence", "cup", "room")
SEEDS = (0, 1, 2)
PRESET = "draft"

FIXED = (
    "--iterations", "1000", "--max-gaussians", "20000", "--max-image-px", "640", "--holdout", "0",
    "--harmonics", "off", "--exposure", "off", "--growth", "on", "--full-size", "on",
    "--spacing", "uniform", "--points", "12000", "--texture-size", "64", "--dense-start", "off",
)  # fmt: skip
"""What no cell varies. The paper starts from sparse points. Records made before there was another
start name `--dense-start off`, too."""

OFF, ON = "off", "on"
PLAIN, ORIENTED, CLONES = "plain", "oriented", "clones"

MULTI_VIEW = {OFF: ("--multi-view", "off"), ON: ("--multi-view", "on")}
WRAPPING = {
    PLAIN: ("--wrapping", "off", "--wrap-rounds", "0"),
    ORIENTED: ("--wrapping", "on", "--wrap-rounds", "0"),
    CLONES: ("--wrapping", "on", "--wrap-rounds", "2"),
}
"""Growth leaves room below the cap for the clones of ``--wrap-rounds``. So the number is given in
every cell: all of them may end with as many Gaussians."""

LABELS = {
    PLAIN: "no orientation",
    ORIENTED: "orientation loss",
    CLONES: "orientation and clones",
}


@dataclasses.dataclass(frozen=True)
class Cell:
    """One combination of the two factors."""

    multi_view: str
    wrapping: str

    @property
    def name(self) -> str:
        """In identities."""
        return f"{'views' if self.multi_view == ON else 'alone'}_{self.wrapping}"

    @property
    def label(self) -> str:
        """Words for tables."""
        return LABELS[self.wrapping]

    @property
    def varied(self) -> tuple[str, ...]:
        """The arguments that make the cell."""
        return (*MULTI_VIEW[self.multi_view], *WRAPPING[self.wrapping])

    def case(self, scene: str, seed: int) -> Case:
        """Return the run of this cell on a scene."""
        return Case(STUDY, scene, self.name, seed, PRESET, (*FIXED, *self.varied))


CELLS = tuple(Cell(views, level) for views in MULTI_VIEW for level in WRAPPING)


def plan() -> list[Case]:
    """Return all runs in the order in which they are made: each seed is a whole factorial."""
    return [cell.case(scene, seed) for seed in SEEDS for scene in SCENES for cell in CELLS]


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
    for scene in (*SCENES, ""):
        for part in PARTS:
            row: Row = {"scene": scene or "all", "added": part.name}
            counts = set()
            for name, figure, digits, more in measured:
                found = differences(records, part, figure, scene)
                counts.add(len(found))
                spread = Spread.of(found)
                seeds = sum(bool(differences(records, part, figure, scene, (s,))) for s in SEEDS)
                row[name] = None if spread is None else _judged(spread, digits, more, seeds > 1)
            if max(counts) > 0:
                rows.append({**row, "pairs": max(counts)})
    return table_of(
        "What each part changes",
        rows,
        "Mean ± standard deviation of the differences between two runs of the same scene and seed "
        "that differ by this part alone. **Bold** with “better” or “worse”: the mean is more than "
        f"{CLEAR:g} standard errors from 0; all other differences say nothing. A figure that "
        "one seed alone has is not judged. Pairs of one seed share its randomness: with so few "
        "seeds the spread is somewhat too narrow.",
    )


def differences(
    records: Records,
    part: Part,
    figure: Figure,
    scene: str = "",
    seeds: Sequence[int] = SEEDS,
) -> list[float]:
    """Return the figure with a part less without it, for every pair of runs (of a scene)."""
    found = []
    for name in SCENES if not scene else (scene,):
        for without, with_it in part.pairs:
            for seed in seeds:
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


NAMES = {OFF: "without multi-view terms", ON: "with multi-view terms"}
SHORT = {PLAIN: "colour, depth-normal", ORIENTED: "+ orientation", CLONES: "+ clones"}
RUNS = "single runs"


def write_plot(records: Records, path: Path) -> None:
    """Write one panel for each scene that has runs: means joined, and every run as a dot."""
    panels = []
    for scene in SCENES:
        runs: list[tuple[float, float]] = []
        means = []
        for views, name in NAMES.items():
            points, labels = [], []
            for cell in CELLS:
                if cell.multi_view != views:
                    continue
                same = [(r.processor("train"), f1_middle(r)) for r in of_cell(records, cell, scene)]
                if same:
                    points.append((statistics.fmean(x for x, _ in same),
                                   statistics.fmean(y for _, y in same)))  # fmt: skip
                    labels.append(SHORT[cell.wrapping])
                    runs += same
            if points:
                means.append(Series(name, points, labels=labels))
        if means:
            several = len(runs) > sum(len(series.points) for series in means)
            single = [Series(RUNS, runs, line=False)] if several else []
            panels.append(
                Panel(scene, "training, processor s", f"F1 at {AT}", [*means, *single],
                      x_log=False, y_log=False)
            )  # fmt: skip
    write_svg(panels, path)


PAGE, PLOT = "ablation.md", "ablation.svg"
COMMAND = "python -m benchmarks.ablation"

_GROWTH = {
    "on": (
        "With `--growth on` only the cap ends growth. Versions that had `auto` pruned nothing",
        "then; later ones do, and have the footprint regulariser.",
    )
}


def write_document(out: Path, records: Records, cases: Sequence[Case]) -> Path:
    """Write page and plot into a folder; the reading lies beside them."""
    write_plot(records, out / PLOT)
    fixed = fixed_options(cases)
    given = ", ".join(f"`{name} {value}`" for name, value in fixed.items())
    tables = (settings_table(cases), part_table(records), cell_table(records))
    lines = [
        *made_by(COMMAND, list(records.values()), cases),
        "",
        photos_said(PHOTOS),
        f"Preset {PRESET}, in every run with {given}.",
        "Nothing is decided from the photos: every part is given.",
        *_GROWTH.get(fixed.get("--growth", ""), ()),
        "Clones turn around what orientation has found. Without orientation there are none: six",
        "cells, not eight.",
        "",
        *reading("ablation"),
        f"![F1 against processor time, every run a dot]({PLOT})",
        "",
        "## Tables",
        "",
        *(table.markdown() for table in tables if table.rows),
    ]
    title = "Ablation: multi-view terms, orientation, clones"
    return write_page(out / PAGE, title, commits(records.values()), lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line asks for; return 1 where a run failed, else 0."""
    return run_study(arguments, __doc__, plan(), write_document)


if __name__ == "__main__":
    raise SystemExit(main())
