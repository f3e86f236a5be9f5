# SPDX-License-Identifier: GPL-3.0-or-later
"""The vacancy kernel against its definition: time and error on the Gaussians of a run.

``python -m benchmarks.speed_error.vacancy_kernel SCENE JOB OUT.json``
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.evaluation.surface.truth import read_truth
from gaussian_wrapping_addon.core.field.vacancy.brute_force import brute_force_vacancy
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.gaussians.gaussian_file import load_gaussians

from .plan import THRESHOLD_SHARES
from .score import stage_folder

KERNEL_POINTS = 200_000
DEFINITION_POINTS = 60


def compare(scene_folder: Path, job: Path, threads: int) -> dict[str, Any]:
    """Return times per point and errors, at points within 1 % of the diagonal of the true surface.

    The kernel is timed when its cameras are prepared and its code is compiled.
    """
    scene = load_saved_scene(stage_folder(job, "cameras"))
    arrays = load_gaussians(stage_folder(job, "train") / "gaussians.npz").arrays()
    truth = read_truth(scene_folder)
    reach = THRESHOLD_SHARES[-1] * float(read_json(scene_folder / "scene.json")["diagonal"])
    generator = np.random.default_rng(0)
    chosen = generator.integers(0, len(truth.samples), KERNEL_POINTS)
    offsets = generator.uniform(-reach, reach, (KERNEL_POINTS, 1))
    world = truth.samples.points[chosen] + offsets * truth.samples.normals[chosen]
    points = scene.world_from_scene.inverse().points(world)
    field = VacancyField(arrays, scene.cameras, threads=threads)
    field.vacancy(points[:DEFINITION_POINTS])
    begun_s = time.perf_counter()
    fast = field.vacancy(points).vacancy[:DEFINITION_POINTS].astype(np.float64)
    kernel_s = time.perf_counter() - begun_s
    begun_s = time.perf_counter()
    exact, camera = brute_force_vacancy(arrays, scene.cameras, points[:DEFINITION_POINTS])
    definition_s = time.perf_counter() - begun_s
    seen = camera >= 0
    error = np.abs(fast - exact)[seen]
    return {
        "gaussians": len(arrays),
        "cameras": len(scene.cameras),
        "kernel_points": KERNEL_POINTS,
        "definition_points": int(seen.sum()),
        "kernel_us": 1e6 * kernel_s / KERNEL_POINTS,
        "definition_us": 1e6 * definition_s / DEFINITION_POINTS,
        "error_median": float(np.median(error)),
        "error_max": float(error.max()),
        "same_side": float(((fast > 0.5) == (exact > 0.5))[seen].mean()),
    }


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
