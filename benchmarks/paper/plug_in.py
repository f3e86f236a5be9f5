# SPDX-License-Identifier: GPL-3.0-or-later
"""Plain 3DGS against the same with Gaussian Wrapping: ``python -m benchmarks.paper.plug_in``.

A plain training by this program's trainer with everything of the method off, its splat for viewers
wrapped with photos and without, and the method from the start; all meshed by the same mesher.
Trainings that exist are kept. Writes a record and the page.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.field.depth_samples import sample_depth_maps
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.points.candidate_surface import halo_bounds
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import MeshingSettings

from ..speed_error.runs import ROOT
from .document import write_page
from .judging import held_out_psnr, level_offsets, score_mesh
from .records import PLUG_IN, origin, read_record, write_record
from .refinement import pam
from .trainings import (
    ALONE,
    FULL,
    HEIGHT,
    ITERATIONS,
    LONGER,
    PHOTOS,
    PLAIN,
    PRESET,
    UNTRAINED,
    WIDTH,
    WRAPPED,
    Trained,
    finished,
)

_logger = logging.getLogger("benchmarks")

ROWS = {
    "wheel": (PLAIN, WRAPPED, FULL, UNTRAINED, ALONE, LONGER),
    "spot": (PLAIN, WRAPPED, FULL, UNTRAINED, ALONE),
}
"""Trainings of each scene."""
POINTS = 10_000
"""Of each mesh: enough for both things, and quick; the same for all rows."""


def mesh_of(trained: Trained, *, threads: int) -> tuple[SurfaceMesh, VacancyField]:
    """Return the adaptive mesh of a training, and its field."""
    region = trained.region
    field = VacancyField(
        trained.gaussians.arrays(), trained.scene.cameras, threads=threads,
        region_bounds=halo_bounds(region),
    )  # fmt: skip
    samples = sample_depth_maps(
        trained.gaussians, trained.scene.cameras, lambda p: region.contains(p, 0.0), Progress(),
        threads=threads,
    )  # fmt: skip
    return pam(trained, field, MeshingSettings(points=POINTS), samples, threads=threads), field


def row_of(scene: str, name: str, *, threads: int) -> dict[str, Any]:
    """Return the figures of one training and its mesh."""
    trained = finished(scene, name, threads=threads)
    begun_s = time.process_time()
    mesh, field = mesh_of(trained, threads=threads)
    meshing_s = time.process_time() - begun_s
    keep = ("iterations", "gaussians", "processor_s", "settings", "code", "date", "load_before")
    return {
        "scene": scene,
        "training": name,
        **{key: trained.facts[key] for key in keep},
        "meshing_processor_s": meshing_s,
        "psnr": held_out_psnr(trained, threads=threads),
        "mesh": score_mesh(trained, mesh, threads=threads),
        "level": level_offsets(trained, field),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, mesh, judge, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "benchmarks")
    parser.add_argument("--scenes", nargs="+", choices=ROWS, default=list(ROWS))
    names = list(dict.fromkeys(name for rows in ROWS.values() for name in rows))
    parser.add_argument("--rows", nargs="+", choices=names, default=names)
    parser.add_argument(
        "--reuse", action="store_true", help="keep finished rows: only if the code is the same"
    )
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    earlier = (read_record(PLUG_IN) or {}).get("rows", []) if options.reuse else []
    done = {(row["scene"], row["training"]): row for row in earlier}
    values: dict[str, Any] = {
        "origin": origin("plug_in", options.threads),
        "photos": [PHOTOS, WIDTH, HEIGHT],
        "preset": PRESET,
        "iterations": ITERATIONS,
        "points": POINTS,
        "rows": list(done.values()),
    }
    for scene in options.scenes:
        for name in options.rows:
            if name in ROWS[scene] and (scene, name) not in done:
                done[scene, name] = row_of(scene, name, threads=options.threads)
                order = [(s, n) for s in ROWS for n in ROWS[s]]
                values["rows"] = [done[key] for key in order if key in done]
                write_record(PLUG_IN, values)
                _logger.info("%s, %s: F1 %s", scene, name, done[scene, name]["mesh"]["f1"])
    _logger.info("written: %s", write_page(options.out))


if __name__ == "__main__":
    main()
