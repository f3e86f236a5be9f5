# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes from the cameras of training against meshes from all cameras, held-out ones included.

``python -m benchmarks.meshing_parts.field_cameras --scenes wheel spot`` renders and trains each
scene once through the command line, meshes it with either choice, and prints a table of both
meshes against the true surface. ``--reuse`` keeps finished trainings and meshes.
"""

from __future__ import annotations

import argparse
import datetime
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.evaluation.surface.scores import score_protocols
from gaussian_wrapping_addon.core.evaluation.surface.truth import read_truth
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.kernels.parallel import default_threads
from gaussian_wrapping_addon.core.machine import processor_name
from gaussian_wrapping_addon.core.settings import FIELD_CAMERAS

from ..scenes import ensure_scene
from ..speed_error.plan import THRESHOLD_SHARES, Run, Variant
from ..speed_error.runs import ROOT, Settings, code_state, measured, run_variant, run_wrap
from ..speed_error.score import SURFACE_SAMPLES, read_textured, stage_folder
from ..tables import Cell, Table, versions

CACHE = ROOT / ".cache" / "field_cameras"

SMALL_TEXTURE = ("--texture-size", "256", "--normal-map", "off")
"""The texture is not looked at."""


def measure(name: str, arguments: Sequence[str], settings: Settings) -> list[dict[str, Any]]:
    """Train a scene, mesh it with each choice of cameras, and return scores and counts."""
    scene = ensure_scene(name, photos=40, width=288, height=216)
    first, *others = FIELD_CAMERAS
    run = Run(name, "draft", arguments=(*arguments, *SMALL_TEXTURE, "--mesh-cameras", first))
    base = run_wrap(run, scene, settings)
    folders = {first: base}
    for number, choice in enumerate(others, 1):
        given = (*SMALL_TEXTURE, "--mesh-cameras", choice)
        variant = Variant("cameras", given, number)
        folders[choice] = run_variant(variant, base, scene, settings)
    return [
        {"scene": name, "cameras": choice, **judge(folder, base / "out", scene, settings.threads)}
        for choice, folder in folders.items()
    ]


def judge(folder: Path, job: Path, scene_folder: Path, threads: int) -> dict[str, Any]:
    """Return the scores and counts of one mesh that a job made."""
    report = measured(folder)["report"]
    (region,) = report["regions"].values()
    mesh = read_textured(folder / "mesh").mesh
    world = load_saved_scene(stage_folder(job, "cameras")).world_from_scene
    diagonal = float(read_json(scene_folder / "scene.json")["diagonal"])
    score = score_protocols(
        world.points(mesh.vertices), mesh.faces, read_truth(scene_folder), [],
        [share * diagonal for share in THRESHOLD_SHARES], count=SURFACE_SAMPLES, seed=0,
        threads=threads, protocols=("uniform",),
    )["uniform"]  # fmt: skip
    provenance = region["provenance"]
    return {
        "count": provenance["field_cameras"],
        "faces": len(mesh.faces),
        "components": region["statistics"]["components"],
        "removed": provenance["removed_solids"],
        "cavities": provenance["removed_cavities"],
        "score": score,
    }


def table(rows: Sequence[dict[str, Any]], notes: Sequence[str]) -> Table:
    """Return the table: per cent within each threshold, and counts."""
    shares = [f"{100 * share:g} %" for share in THRESHOLD_SHARES]
    header = (
        "scene", "cameras", "number", *(f"F1 {s}" for s in shares),
        *(f"{name} {s}" for name in ("precision", "recall") for s in shares),
        "faces", "components", "removed solids", "removed cavities",
    )  # fmt: skip
    lines: list[tuple[Cell, ...]] = []
    for row in rows:
        score = row["score"]
        values = (*score.f1, *score.precision, *score.recall)
        lines.append(
            (
                row["scene"], row["cameras"], row["count"], *(f"{v:.4f}" for v in values),
                row["faces"], row["components"], row["removed"], row["cavities"],
            )
        )  # fmt: skip
    return Table("Cameras of training, or all cameras", header, lines, tuple(notes))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=["wheel", "spot"])
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--reuse", action="store_true", help="only for the same code")
    options = parser.parse_args(arguments)
    settings = Settings(CACHE, options.threads or default_threads(), options.reuse)
    given = ("--iterations", str(options.iterations))
    rows = [row for name in options.scenes for row in measure(name, given, settings)]
    words = " ".join(sys.argv[1:] if arguments is None else list(arguments))
    command = f"python -m benchmarks.meshing_parts.field_cameras {words}".strip()
    notes = (
        f"`{command}`, {datetime.date.today().isoformat()}, code {code_state()}.",
        f"{processor_name()}, {settings.threads} threads; {versions()}.",
        "40 photos of 288 x 216, every eighth held out, preset draft.",
    )
    sys.stdout.write(table(rows, notes).markdown())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
