# SPDX-License-Identifier: GPL-3.0-or-later
"""The training study as Markdown: tables, plots, pictures, and the reading beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import write_bytes

from ..speed_error.document import made_by, reading
from ..speed_error.pictures import write_comparison
from ..tables import Table
from .acceptance import COMPARED, acceptance_table
from .carry_out import Measured, Outcome
from .figures import write_plots
from .plan import BASELINE, WITH, WITHOUT, WRAPPING
from .tables import (
    ablation_table,
    decision_table,
    missing_table,
    needs_table,
    pivot_table,
    preset_table,
    real_table,
)

STUDY, ACCEPTANCE = "training", "training-acceptance"
"""Names of the two pages; each has a hand-written ``*-reading.md`` beside it."""


def write_study(out: Path, outcome: Outcome, facts: dict[str, Any]) -> Path:
    """Write ``training.md``, its plots and its pictures into a folder.

    Parameters
    ----------
    out : Path
        Must exist.
    outcome : Outcome
    facts : dict
        ``command`` and ``date``.
    """
    runs = outcome.runs
    write_plots(runs, out / f"{STUDY}.svg")
    shown = [m.case.run.scene for m in runs if m.case.run.name == WRAPPING and m.case.photos]
    names = (BASELINE, WRAPPING)
    pictures = _pictures(out, STUDY, runs, list(dict.fromkeys(shown)), names)
    tables = [
        ablation_table(runs),
        real_table(runs),
        pivot_table(outcome.pivots),
        preset_table(runs),
        needs_table(runs),
        decision_table(runs),
        missing_table(outcome.missing),
    ]
    lines = [
        "# What each part of training costs and gains",
        "",
        *made_by([m.result for m in runs], facts),
        "",
        *_photos(runs),
        "",
        f"Whether training reaches its targets: [{ACCEPTANCE}.md]({ACCEPTANCE}.md).",
        "",
        f"![Plots]({STUDY}.svg)",
        "",
        *reading(out / f"{STUDY}-reading.md", facts["date"]),
        *pictures,
        *_tables(tables),
    ]
    return _write(out / f"{STUDY}.md", lines)


def write_acceptance(out: Path, outcome: Outcome, facts: dict[str, Any]) -> Path:
    """Write ``training-acceptance.md`` and its pictures; see :func:`write_study`."""
    runs = outcome.runs
    pictures = _pictures(out, ACCEPTANCE, runs, list(COMPARED), (WITHOUT, WITH))
    tables = [
        acceptance_table(runs),
        needs_table(runs),
        decision_table(runs),
        missing_table(outcome.missing),
    ]
    lines = [
        "# Targets of training",
        "",
        *made_by([m.result for m in runs], facts),
        "",
        *_photos(runs),
        "",
        *reading(out / f"{ACCEPTANCE}-reading.md", facts["date"]),
        *_tables(tables[:1]),
        *pictures,
        *_tables(tables[1:]),
    ]
    return _write(out / f"{ACCEPTANCE}.md", lines)


def _pictures(
    out: Path, page: str, runs: Sequence[Measured], scenes: Sequence[str], names: Sequence[str]
) -> list[str]:
    """Draw meshes of one scene and size side by side, where all that are asked for exist."""
    lines: list[str] = []
    for scene in scenes:
        rows = {m.case.run.name: m for m in runs if m.case.run.scene == scene and m.case.photos}
        if not set(names) <= set(rows):
            continue
        name = f"{page}-{scene}.jpg"
        compared = [(rows[n].case.label, rows[n].folder) for n in names]
        write_comparison(rows[names[0]].scene, compared, out / name)
        lines += [f"![{scene}]({name})", ""]
    if not lines:
        return []
    return [
        "## What it looks like",
        "",
        "Above: a test photo and the textured meshes. Below: the true surface, and the meshes",
        "coloured by the distance of each face's centre to it: blue within 0.25 % of the diagonal,",
        "green within 0.5 %, yellow within 1 %, red beyond; grey is not judged.",
        "",
        *lines,
    ]


def _photos(runs: Sequence[Measured]) -> list[str]:
    """Return which photos were used."""
    sizes = dict.fromkeys(m.case.photos for m in runs if m.case.photos is not None)
    lines = [
        f"Rendered scenes: {p.count} photos of {p.width} x {p.height} pixels, exact cameras, 8 test"
        " views apart."
        for p in sizes
    ]
    if any(m.case.photos is None for m in runs):
        lines.append("Real photos: as they are, with the cameras of their COLMAP model.")
    return [*lines, "Seed 0."]


def _tables(tables: Sequence[Table]) -> list[str]:
    filled = [table.markdown() for table in tables if table.rows]
    return ["## Tables", "", *filled] if len(tables) > 1 and filled else filled


def _write(path: Path, lines: list[str]) -> Path:
    write_bytes(path, ("\n".join(lines).rstrip() + "\n").encode())
    return path
