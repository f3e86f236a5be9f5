# SPDX-License-Identifier: GPL-3.0-or-later
"""The meshing study as Markdown: targets, plots, tables, and the reading beside them."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import write_bytes
from gaussian_wrapping_addon.core.machine import processor_name

from ..speed_error.tables import missing_table
from ..tables import versions
from .acceptance import acceptance_table
from .carry_out import Outcome
from .figures import SHOWN, write_plots
from .tables import cost_table, isosurface_table, solid_table, training_table, truth_table

PAGE = "meshing"
"""Name of the page; a hand-written ``meshing-reading.md`` may lie beside it."""


def write_document(out: Path, outcome: Outcome, facts: dict[str, Any]) -> Path:
    """Write ``meshing.md`` and its plots into a folder.

    Parameters
    ----------
    out : Path
        Must exist.
    outcome : Outcome
    facts : dict
        ``command``, ``date`` and ``threads``.
    """
    made = outcome.made
    plots = out / f"{PAGE}.svg"
    plots.unlink(missing_ok=True)
    write_plots(made, plots)
    tables = [
        cost_table(made),
        isosurface_table(made),
        truth_table(made),
        solid_table(made),
        training_table(outcome.trainings),
        missing_table(outcome.missing),
    ]
    targets = acceptance_table(outcome)
    lines = [
        "# Meshing: speed against error",
        "",
        *_made_by(outcome, facts),
        "",
        *_photos(outcome),
        "",
        *reading(out / f"{PAGE}-reading.md", facts["date"]),
        *([targets.markdown()] if targets.rows else []),
        *([f"![Plots]({PAGE}.svg)", "", _plot_words(), ""] if plots.is_file() else []),
        "## Tables",
        "",
        *(table.markdown() for table in tables if table.rows),
    ]
    path = out / f"{PAGE}.md"
    write_bytes(path, ("\n".join(lines).rstrip() + "\n").encode())
    return path


def _made_by(outcome: Outcome, facts: dict[str, Any]) -> list[str]:
    """Return command, date, machine, versions, code, load and time, as lines."""
    made = outcome.made
    trained = sorted({run.get("code", "not recorded") for run in outcome.trainings.values()})
    codes = sorted({m.figures["code"] for m in made})
    loads = [m.figures["load_before"] for m in made if m.figures["load_before"] is not None]
    seconds = sum(m.figures["wall_s"] + m.scores["seconds_scoring"] for m in made)
    seconds += sum(run["wall_s"] for run in outcome.trainings.values())
    load = f"{max(loads):.1f}" if loads else "not recorded"
    return [
        f"`{facts['command']}`, {facts['date']}. {processor_name()}, {facts['threads']} threads;",
        f"{versions()}, Open3D {_open3d()}.",
        f"Code of the meshes: {', '.join(codes) or 'none'}; of the trainings:",
        f"{', '.join(trained) or 'none'}. {len(made)} meshes; they, their scores and the trainings",
        f"took {seconds / 60:.0f} minutes (references not counted); largest load average before a",
        f"mesh: {load}.",
    ]


def _photos(outcome: Outcome) -> list[str]:
    subjects = {m.subject.name: m.subject for m in outcome.made}.values()
    sizes = dict.fromkeys(s.photos for s in subjects if s.photos is not None)
    lines = [
        f"Rendered scenes: {p.count} photos of {p.width} x {p.height} pixels, exact cameras, true "
        "surface known."
        for p in sizes
    ]
    if any(s.photos is None for s in subjects):
        lines.append("Real photos: as they are, with the cameras of their COLMAP model; no truth.")
    presets = sorted({s.run.preset for s in subjects})
    return [*lines, f"Trained by preset {', '.join(presets)}, seed 0. Methods of a scene share it."]


def _plot_words() -> str:
    scenes = ", ".join(SHOWN)
    return (
        f"Of {scenes}, where measured. Numbers beside points: points asked for, pivots a Gaussian, "
        "voxels along the diagonal."
    )


def _open3d() -> str:
    try:
        return metadata.version("open3d")
    except metadata.PackageNotFoundError:
        return "is not installed"


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
