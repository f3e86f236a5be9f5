# SPDX-License-Identifier: GPL-3.0-or-later
"""The report as Markdown: tables, plots, pictures, and the words around them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import read_json, write_bytes

from ..tables import Cell, Table, processor, versions
from .figures import write_plots
from .pictures import write_comparison
from .plan import MAIN_SCENES, THRESHOLD_SHARES
from .results import Outcome, Result, plain
from .tables import (
    bias_table,
    cost_table,
    image_table,
    kernel_table,
    pose_table,
    seed_table,
    stage_table,
    surface_table,
    varied_tables,
)

PLOTS = "speed-vs-error.svg"
READING = "reading.md"
"""Written by hand beside the report, with the date of the figures that it reads."""


def write_document(out: Path, outcome: Outcome, facts: dict[str, Any]) -> None:
    """Write ``README.md``, the plots and the pictures into a folder.

    Parameters
    ----------
    out : Path
        Must exist.
    outcome : Outcome
    facts : dict
        ``command``, ``date``, ``minutes``, ``reused``, ``photos``, ``runs`` (folder of the runs).
    """
    results, poses = outcome.results, outcome.poses
    write_plots(results, out / PLOTS)
    pictures = _pictures(out, results, outcome.folders, facts["runs"])
    reading = out / READING
    tables = [
        _scene_table(outcome.folders),
        cost_table(results),
        surface_table(results, outcome.ceilings),
        image_table(results),
        stage_table(results, poses),
        pose_table(poses),
        kernel_table(outcome.kernels),
        seed_table(results),
        bias_table(results),
        *varied_tables(results),
    ]
    photos, threads = facts["photos"], results[0].report["machine"]["threads"]
    minutes = math.fsum(r.wall_s + r.scores["seconds_scoring"] for r in results)
    minutes = (minutes + math.fsum(p["seconds"] for p in poses.values())) / 60.0
    lines = [
        "# Speed against error",
        "",
        *(
            f"`{facts['command']}`, {facts['date']}. {processor()}, {threads} threads;",
            f"{versions()}. {photos.count} photos of {photos.width} x {photos.height} pixels and",
            f"8 test views a scene. Seed 0, where no other is named. {len(results)} meshes; runs",
            f"and scores took {minutes:.0f} minutes{_reuse_note(facts)}.",
        ),
        "",
        f"![Plots]({PLOTS})",
        "",
        *([reading.read_text(encoding="utf-8").strip(), ""] if reading.is_file() else []),
        *_headline(results),
        *pictures,
        _words("protocol"),
        "## Tables",
        "",
        *(table.markdown() for table in tables if table.rows),
        _words("other_measurements"),
    ]
    write_bytes(out / "README.md", ("\n".join(lines).rstrip() + "\n").encode())


def _reuse_note(facts: dict[str, Any]) -> str:
    if facts["reused"]:
        return ", in several sittings with the same code"
    return f", all in all {facts['minutes']:.0f}"


def _headline(results: Sequence[Result]) -> list[str]:
    """Return one sentence a scene, made from the figures alone."""
    lines = ["## In short", ""]
    for scene in MAIN_SCENES:
        same = {r.run.preset: r for r in plain(results, scene)}
        if "draft" not in same:
            continue
        words = []
        for preset, r in same.items():
            words.append(
                f"{preset} {r.f1('uniform', 1):.2f} ({r.f1('scan', 1):.2f} of what is seen) in "
                f"{r.wall_s:.0f} s"
            )
        thin = same["draft"].surface("uniform", "thin_recall")
        last = list(same.values())[-1]
        extra = ""
        if thin is not None:
            best = last.surface("uniform", "thin_recall")
            extra = f"; thin parts found: {thin[1]:.2f} to {best[1]:.2f}"
        lines.append(
            f"- **{scene}**: F1 at {100 * THRESHOLD_SHARES[1]:g} %: {', '.join(words)}{extra}."
        )
    return [*lines, ""]


def _pictures(
    out: Path, results: Sequence[Result], folders: dict[str, Path], runs: Path
) -> list[str]:
    lines = [
        "## What it looks like",
        "",
        *(
            "Above: a test photo and the textured meshes. Below: the true surface, and the",
            "meshes coloured by the distance of each face to it: blue within 0.25 % of the",
            "diagonal, green within 0.5 %, yellow within 1 %, red beyond.",
        ),
        "",
    ]
    for scene, folder in folders.items():
        same = plain(results, scene)
        if not same:
            continue
        name = f"scene-{scene}.jpg"
        shown = [(r.run.preset, runs / r.run.identity) for r in same]
        write_comparison(folder, shown, out / name)
        lines += [f"![{scene}]({name})", ""]
    return lines


def _scene_table(folders: dict[str, Path]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, folder in folders.items():
        values = read_json(folder / "scene.json")
        rows.append((name, values["role"], values["description"]))
    return Table("Scenes", ("scene", "role", "what it is"), rows)


def _words(name: str) -> str:
    """Return prose that does not depend on figures, with its heading."""
    path = Path(__file__).with_name(f"{name}.md")
    return path.read_text(encoding="utf-8").strip() + "\n"
