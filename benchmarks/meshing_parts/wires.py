# SPDX-License-Identifier: GPL-3.0-or-later
"""Why the mesh of a thing made of wires has another Euler characteristic than the thing.

``python -m benchmarks.meshing_parts.wires SCENE_FOLDER JOB`` prints how closely the true wires pass
one another, in pixels of the photos, and how often the trained field is filled there; and how often
it is empty on the wires' centre lines, where the mesh must have a gap.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from gaussian_wrapping_addon.core.evaluation.surface.truth import read_truth
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.kernels.parallel import default_threads

from ..meshing_study.trained import open_trained

MAX_GAP_PX = 1.6
"""Wires that pass closer than this, in pixels, count as a crossing."""
APART_PX = 8.0
"""Crossings lie farther apart than this, in pixels."""
FIRST_SHARE = 1e-5
"""Of the diagonal: rays start this far off the surface."""


def first_hits(mesh: object, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return (n,) distances along rays to a trimesh, inf where nothing is hit."""
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    caster = RayMeshIntersector(mesh, scale_to_box=False)
    points, rays, _ = caster.intersects_location(origins, directions, multiple_hits=False)
    found = np.full(len(origins), np.inf)
    found[rays] = np.linalg.norm(points - origins[rays], axis=1)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures."""
    import trimesh

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("job", type=Path)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args(arguments)
    trained = open_trained(options.scene, options.job)
    truth = read_truth(options.scene)
    assert truth.mesh is not None
    mesh = trimesh.Trimesh(*truth.mesh, process=False)
    data = np.load(options.scene / "truth.npz", allow_pickle=False)
    thin = data["thin"]
    points, normals = data["points"][thin], data["normals"][thin]
    diagonal = float(np.linalg.norm(np.ptp(truth.mesh[0], axis=0)))
    start = FIRST_SHARE * diagonal
    field = VacancyField(
        trained.gaussians.arrays(), trained.scene.cameras,
        threads=options.threads or default_threads(),
    )  # fmt: skip
    scene_from_world = trained.scene.world_from_scene.inverse()

    def empty(where: np.ndarray) -> np.ndarray:
        return np.asarray(field.is_empty(scene_from_world.points(where)))

    middle = truth.mesh[0].mean(0)
    world = trained.scene.world_from_scene
    pixels = [
        np.linalg.norm(world.points(c.center[None])[0] - middle) / c.fx
        for c in trained.scene.cameras
    ]
    pixel = float(np.median(pixels))
    gap = first_hits(mesh, points + start * normals, normals)
    close = gap < MAX_GAP_PX * pixel
    near, between = points[close], points[close] + normals[close] * gap[close, None] / 2
    crossing = fcluster(linkage(near, "single"), APART_PX * pixel, "distance")
    numbers = np.unique(crossing)
    smallest = np.array([gap[close][crossing == k].min() for k in numbers])
    filled = ~empty(between)
    joined = np.array([filled[crossing == k].any() for k in numbers])
    lines = [
        f"a pixel: {pixel:.4f}, {100 * pixel / diagonal:.3f} % of the thing's diagonal",
        (
            f"places where thin parts come closer than {MAX_GAP_PX} pixels: {len(numbers)}; "
            f"smallest gap, median: {np.median(smallest) / pixel:.2f} pixels; filled somewhere by "
            f"the trained field: {int(joined.sum())}"
        ),
    ]
    depth = first_hits(mesh, points - start * normals, -normals)
    wire = depth < 1.05 * np.median(depth)
    centre = points[wire] - normals[wire] * depth[wire, None] / 2
    lines.append(
        f"wires, median thickness {np.median(depth) / pixel:.2f} pixels: "
        f"{100 * empty(centre).mean():.2f} % of their centre lines are empty"
    )
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
