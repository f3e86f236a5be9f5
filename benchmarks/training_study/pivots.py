# SPDX-License-Identifier: GPL-3.0-or-later
"""Marching tetrahedra from two and from nine pivots of one training, against the true surface.

``python -m benchmarks.training_study.pivots SCENE JOB OUT.json``. Judged is the mesh of the pivots
alone, as the paper does: without other points, of every Gaussian, nothing removed for its size.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.evaluation.surface.scores import score_protocols
from gaussian_wrapping_addon.core.evaluation.surface.truth import read_truth
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.gaussians.gaussian_file import load_gaussians
from gaussian_wrapping_addon.core.meshing.pivot_meshing import mesh_by_pivots
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.region import read_region
from gaussian_wrapping_addon.core.settings import MeshingSettings

from ..speed_error.plan import THRESHOLD_SHARES
from ..speed_error.score import SURFACE_SAMPLES, mesh_scene, stage_folder

PIVOTS = (2, 9)
"""Of each Gaussian, as in the paper's table."""


def compare(scene_folder: Path, job: Path, threads: int) -> dict[str, Any]:
    """Return points, faces, seconds and surface scores for either number of pivots."""
    scene = load_saved_scene(stage_folder(job, "cameras"))
    arrays = load_gaussians(stage_folder(job, "train") / "gaussians.npz").arrays()
    world = scene.world_from_scene
    region = read_region(scene_folder / "region.json").transformed(world.inverse())
    cameras = mesh_scene(job, scene).cameras
    field = VacancyField(arrays, cameras, threads=threads)
    truth = read_truth(scene_folder)
    diagonal = float(read_json(scene_folder / "scene.json")["diagonal"])
    thresholds = [share * diagonal for share in THRESHOLD_SHARES]
    field.is_empty(arrays.means[:64])  # kernels and cameras are prepared before anything is timed
    found: dict[str, Any] = {}
    for number in PIVOTS:
        begun_s = time.monotonic()
        settings = MeshingSettings(
            method="pivots", pivots=number, pivot_samples="none", min_component_share=0.0
        )
        mesh = mesh_by_pivots(field, arrays, cameras, region, settings, Progress(), seed=0)
        seconds = time.monotonic() - begun_s
        score = score_protocols(
            world.points(mesh.vertices), mesh.faces, truth, [], thresholds,
            count=SURFACE_SAMPLES, threads=threads, protocols=("uniform",),
        )["uniform"]  # fmt: skip
        found[str(number)] = {
            "points": mesh.provenance["pivots"],
            "faces": len(mesh.faces),
            "seconds": seconds,
            "surface": score.to_json(),
        }
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("job", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args(arguments)
    write_json(options.out, compare(options.scene, options.job, options.threads))


if __name__ == "__main__":
    main()
