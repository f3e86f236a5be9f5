# SPDX-License-Identifier: GPL-3.0-or-later
"""The report as Markdown: tables, plots, pictures, and the words around them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import read_json, write_bytes
from gaussian_wrapping_addon.core.machine import processor_name

from ..tables import Cell, Table, versions
from .figures import write_plots
from .pictures import write_comparison
from .plan import MAIN_SCENES
from .results import Outcome, Result, plain
from .tables import (
    AT,
    cost_table,
    image_table,
    kernel_table,
    pose_table,
    stage_table,
    surface_table,
    thin_recall,
)
from .varied_tables import (
    gaussian_table,
    image_size_table,
    mesh_table,
    seed_table,
    texture_table,
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
        ``command``, ``date``, ``photos`` (:class:`.plan.Photos`), ``runs`` (folder of the runs).
    """
    results = outcome.results
    photos = facts["photos"]
    side_px = max(photos.width, photos.height)
    write_plots(results, side_px, out / PLOTS)
    pictures = _pictures(out, results, outcome.folders, facts["runs"])
    tables = [
        _scene_table(outcome.folders),
        cost_table(results),
        surface_table(results, outcome.ceilings),
        image_table(results),
        stage_table(results, outcome.poses),
        pose_table(outcome.poses),
        kernel_table(outcome.kernels),
        seed_table(results),
        mesh_table(results),
        gaussian_table(results),
        image_size_table(results, side_px),
        texture_table(results),
    ]
    lines = [
        "# Speed against error",
        "",
        *_origin(outcome, facts),
        "",
        f"![Plots]({PLOTS})",
        "",
        *reading(out / READING, facts["date"]),
        *_headline(results),
        *pictures,
        _words("protocol"),
        "## Tables",
        "",
        *(table.markdown() for table in tables if table.rows),
        _words("other_measurements"),
    ]
    write_bytes(out / "README.md", ("\n".join(lines).rstrip() + "\n").encode())


def _origin(outcome: Outcome, facts: dict[str, Any]) -> list[str]:
    """Return where the figures come from: command, machine, versions, code, time."""
    photos = facts["photos"]
    poses_s = math.fsum(p["seconds"] for p in outcome.poses.values())
    return [
        *made_by(outcome.results, facts, poses_s),
        "",
        f"{photos.count} photos of {photos.width} x {photos.height} pixels and 8 test views a",
        "scene. That is smaller than Draft, Standard and Fine would use (up to 480, 640 and 1024",
        "pixels), so that all runs fit into the time: here the presets differ by iterations,",
        "Gaussians and harmonics only. Seed 0, where no other is named.",
    ]


def made_by(results: Sequence[Result], facts: dict[str, Any], more_s: float = 0.0) -> list[str]:
    """Return command, date, machine, versions, code, time and load of some runs, as lines.

    Parameters
    ----------
    facts : dict
        ``command`` and ``date``.
    more_s : float
        Time that was spent besides runs and scores.
    """
    codes = sorted({r.measured.get("code", "not recorded") for r in results})
    loads = [r.measured.get("load_before") for r in results]
    seconds = math.fsum(r.wall_s + r.scores.get("seconds_scoring", 0.0) for r in results) + more_s
    known = [load for load in loads if load is not None]
    load = f"{max(known):.1f}" if len(known) == len(loads) else "not recorded for all runs"
    machine = f"{processor_name()}, {results[0].report['machine']['threads']} threads; {versions()}"
    return [
        f"`{facts['command']}`, {facts['date']}. {machine}.",
        f"Code: {', '.join(codes)}. {len(results)} meshes; runs and scores took",
        f"{seconds / 60:.0f} minutes; largest load average before a run: {load}.",
    ]


def reading(path: Path, date: str) -> list[str]:
    """Return the hand-written reading; its first line is the date of the figures that it reads."""
    if not path.is_file():
        return []
    written, _, text = path.read_text(encoding="utf-8").partition("\n")
    stale = (
        [] if written.strip() == date else [f"*Written for the figures of {written.strip()}.*", ""]
    )
    heading, _, rest = text.strip().partition("\n")
    return [heading, "", *stale, rest.strip(), ""]


def _headline(results: Sequence[Result]) -> list[str]:
    """Return one sentence a scene, made from the figures alone."""
    lines = [
        "## In short",
        "",
        f"F1 at {AT} of the diagonal, whole surface; in brackets what cameras see.",
        "",
    ]
    for scene in MAIN_SCENES:
        same = plain(results, scene)
        words = [
            f"{r.run.preset} {r.f1('uniform', 1):.2f} ({r.f1('scan', 1):.2f}) in {r.wall_s:.0f} s"
            for r in same
        ]
        thin = [thin_recall(r.scores["surface"]["uniform"]) for r in same]
        found = [f"{value:.2f}" for value in thin if value is not None]
        extra = f"; thin parts found: {', '.join(found)}" if found else ""
        if words:
            lines.append(f"- **{scene}**: {', '.join(words)}{extra}.")
    return [*lines, ""]


def _pictures(
    out: Path, results: Sequence[Result], folders: dict[str, Path], runs: Path
) -> list[str]:
    lines = [
        "## What it looks like",
        "",
        *(
            "Above: a test photo and the textured meshes. Below: the true surface, and the",
            "meshes coloured by the distance of each face's centre to it: blue within 0.25 %",
            "of the diagonal, green within 0.5 %, yellow within 1 %, red beyond; grey lies",
            "outside of the crop volume and is not judged.",
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
