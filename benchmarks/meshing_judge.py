# SPDX-License-Identifier: GPL-3.0-or-later
"""Judge one mesh: against the field, the isosurface's reference mesh, the truth, and as a solid.

``python -m benchmarks.meshing_judge SCENE JOB MESH.npz REFERENCE.npz OUT.json``

Every mesh is judged by the same program, whatever made it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from gaussian_wrapping_addon.core.evaluation.surface_scores import read_truth, score_protocols
from gaussian_wrapping_addon.core.field.isosurface_projection import isosurface_residuals
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.files import finite_json, read_json, write_json
from gaussian_wrapping_addon.core.mesh.sampling import distances_to_mesh, sample_triangles
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh, load_mesh
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.parallel import default_threads
from gaussian_wrapping_addon.core.regions.shapes import Region

from .one_mesh import Trained, open_trained
from .runs import THRESHOLD_SHARES
from .score import SURFACE_SAMPLES

SAMPLES = 100_000
"""Points on each surface that distances are measured from; with its vertices for Hausdorff."""

INNER_SHARE = 0.005
"""What lies nearer to the region's boundary (share of the diagonal), or beyond it, is not judged:
some methods close the surface there, others leave it open or go on."""


def inner(region: Region, points: np.ndarray) -> np.ndarray:
    """Tell which of (n, 3) points lie well inside of the region, (n,) bool."""
    return region.distance(points) < -INNER_SHARE * region.diagonal


def distances(mesh: SurfaceMesh, reference: SurfaceMesh, region: Region) -> dict[str, float | None]:
    """Return distances both ways between a mesh and the isosurface, shares of the diagonal.

    Returns
    -------
    dict
        ``mean``, ``p99``, ``max`` from the mesh to the reference; ``reference_*`` the other way,
        large where the mesh lacks a part; ``hausdorff``, the larger ``max``. ``None`` where a side
        has nothing inside of the region.
    """
    found: dict[str, float | None] = {}
    for prefix, a, b in (("", mesh, reference), ("reference_", reference, mesh)):
        samples, _ = sample_triangles(a.vertices, a.faces, SAMPLES, np.random.default_rng(0))
        points = np.concatenate([samples, a.vertices])
        kept = inner(region, points)
        away = distances_to_mesh(points[kept], b.vertices, b.faces)[0] / region.diagonal
        # Means of the samples alone: vertices stand closer where a mesh is finer.
        even = away[: int(kept[: len(samples)].sum())]
        told = len(even) > 0
        found |= {
            f"{prefix}mean": float(even.mean()) if told else None,
            f"{prefix}p99": float(np.quantile(even, 0.99)) if told else None,
            f"{prefix}max": float(away.max()) if told else None,
        }
    largest = (found["max"], found["reference_max"])
    found["hausdorff"] = None if None in largest else max(v for v in largest if v is not None)
    return found


def solidity(mesh: SurfaceMesh) -> dict[str, Any]:
    """Return our own check of the mesh, and trimesh's opinion besides."""
    other = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, validate=False)
    closed = bool(other.is_watertight and other.is_winding_consistent)
    return {
        "check": validate_manifold(mesh.vertices, mesh.faces).to_json(),
        "trimesh_good": closed and float(other.volume) > 0.0,
    }


def against_truth(
    mesh: SurfaceMesh, trained: Trained, scene_folder: Path, threads: int
) -> dict[str, Any]:
    """Return the scores against the true surface, and the truth's own Euler characteristic."""
    truth = read_truth(scene_folder)
    diagonal = float(read_json(scene_folder / "scene.json")["diagonal"])
    world = trained.scene.world_from_scene
    score = score_protocols(
        world.points(mesh.vertices), mesh.faces, truth, [],
        [share * diagonal for share in THRESHOLD_SHARES], count=SURFACE_SAMPLES, seed=0,
        threads=threads, protocols=("uniform",),
    )["uniform"]  # fmt: skip
    euler = None if truth.mesh is None else validate_manifold(*truth.mesh).euler
    return {"uniform": score.to_json(), "diagonal": diagonal, "euler": euler}


def judge(
    trained: Trained,
    mesh: SurfaceMesh,
    reference: SurfaceMesh,
    scene_folder: Path,
    *,
    threads: int,
) -> dict[str, Any]:
    """Return all figures of a mesh as JSON values."""
    field = VacancyField(trained.gaussians.arrays(), trained.scene.cameras, threads=threads)
    points = mesh.vertices[inner(trained.region, mesh.vertices)]
    values: dict[str, Any] = {
        "level": isosurface_residuals(field, points),
        "distance": distances(mesh, reference, trained.region),
        "reference_vertices": len(reference.vertices),
        **solidity(mesh),
    }
    if (scene_folder / "truth.npz").is_file():
        values["truth"] = against_truth(mesh, trained, scene_folder, threads)
    return dict(finite_json(values))


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("scene", "job", "mesh", "reference", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args(arguments)
    begun_s = time.monotonic()
    figures = judge(
        open_trained(options.scene, options.job), load_mesh(options.mesh),
        load_mesh(options.reference), options.scene,
        threads=options.threads or default_threads(),
    )  # fmt: skip
    write_json(options.out, {**figures, "seconds_scoring": time.monotonic() - begun_s})


if __name__ == "__main__":
    main()
