# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface error against number of vertices, for uniform and adaptive spacing of one scene.

``python -m benchmarks.meshing_parts.spacing SCENE GAUSSIANS.npz --points 6000 12000 24000``

Both kinds of mesh are compared with a much finer uniform mesh of the same field, from samples of
either one to the other, and with the true surface where the scene folder holds it. Distances are
shares of the region's diagonal. The vertex counts at which both reach the same error are
interpolated on logarithmic axes (:func:`vertex_ratio`).
"""

from __future__ import annotations

import argparse
import json
import logging
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.dataset.similarity import Similarity
from gaussian_wrapping_addon.core.evaluation.surface.scores import score_protocols
from gaussian_wrapping_addon.core.evaluation.surface.truth import Truth, read_truth
from gaussian_wrapping_addon.core.field.depth_samples import sample_depth_maps
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.field.vector_field import VectorField
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.gaussians.gaussian_file import load_gaussians
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.mesh.distance import distances_to_mesh
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.surface_sampling import sample_triangles
from gaussian_wrapping_addon.core.meshing.checks.mesh_statistics import mesh_statistics
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.automatic_region import automatic_region
from gaussian_wrapping_addon.core.regions.convex_region import Region
from gaussian_wrapping_addon.core.regions.region import parse_region
from gaussian_wrapping_addon.core.settings import SPACINGS, MeshingSettings

_logger = logging.getLogger(__name__)

SAMPLES = 100_000
"""Points on each surface that distances are measured from."""

REFERENCE_FACTOR = 8
"""The reference has so many times the points of the finest mesh that is judged: about three times
shorter edges, an eighth of its chord errors."""

F1_SHARE = 0.005
"""Threshold of the F1 to the truth, of the region's diagonal."""

ERRORS = ("mean", "p99", "reference_mean", "reference_p99")


class MeasuredScene:
    """Fields of trained Gaussians over a region, meshed again and again."""

    def __init__(
        self,
        gaussians: OrientedGaussians,
        cameras: Sequence[Camera],
        region: Region,
        *,
        threads: int,
        truth: Truth | None = None,
        world_from_scene: Similarity | None = None,
    ) -> None:
        self.cameras, self.region, self.threads = list(cameras), region, threads
        self.arrays = gaussians.arrays()
        self.vacancy = VacancyField(self.arrays, self.cameras, threads=threads)
        self.vectors = VectorField(self.arrays, threads=threads)
        self.depth_samples = sample_depth_maps(
            gaussians, self.cameras, lambda p: region.contains(p, 0.0), Progress(), threads=threads
        )
        self.truth, self.world_from_scene = truth, world_from_scene

    def mesh(self, points: int, spacing: str) -> tuple[SurfaceMesh, float, float]:
        """Return a mesh, its wall seconds and its processor seconds."""
        begun_s, cpu_s = time.monotonic(), time.process_time()
        mesh = mesh_region(
            self.vacancy, self.vectors, self.arrays, self.cameras, self.region,
            MeshingSettings(points=points, spacing=spacing), Progress(), seed=0,
            threads=self.threads, depth_samples=self.depth_samples,
        )  # fmt: skip
        return mesh, time.monotonic() - begun_s, time.process_time() - cpu_s

    def judged(self, mesh: SurfaceMesh, reference: SurfaceMesh) -> dict[str, float]:
        """Return distances both ways in shares of the diagonal, and F1 to the truth if known.

        Caps on the region's boundary are part of both surfaces.
        """
        to, back = (
            _sampled_distances(a, b) / self.region.diagonal
            for a, b in ((mesh, reference), (reference, mesh))
        )
        figures = {
            "mean": float(to.mean()),
            "p99": float(np.quantile(to, 0.99)),
            "reference_mean": float(back.mean()),
            "reference_p99": float(np.quantile(back, 0.99)),
        }
        if self.truth is not None and self.world_from_scene is not None:
            world = self.world_from_scene
            threshold = F1_SHARE * self.region.diagonal * world.scale
            scores = score_protocols(
                world.points(mesh.vertices), mesh.faces, self.truth,
                [camera.moved(world) for camera in self.cameras], [threshold], count=SAMPLES,
                seed=0, threads=self.threads,
            )["uniform"].to_json()  # fmt: skip
            figures["f1"] = scores["f1"][0]
            if scores.get("thin_recall"):
                figures["thin_recall"] = scores["thin_recall"][0]
        return figures


def measure_spacings(scene: MeasuredScene, points: Sequence[int]) -> dict[str, Any]:
    """Mesh with both spacings at each number of points, and judge every mesh.

    Returns
    -------
    dict
        ``meshes``: one entry a mesh; ``vertex_ratio``: for each kind of error, vertices that
        adaptive spacing needs, of those of uniform spacing (see :func:`vertex_ratio`).
    """
    reference, _, _ = scene.mesh(REFERENCE_FACTOR * max(points), "uniform")
    meshes = []
    for spacing in SPACINGS:
        for count in points:
            mesh, wall_s, cpu_s = scene.mesh(count, spacing)
            statistics, notes = mesh_statistics(mesh), mesh.provenance
            meshes.append({
                "spacing": spacing, "points": count, "vertices": len(mesh.vertices),
                "wall_s": wall_s, "cpu_s": cpu_s,
                "level_error_median": notes.get("level_error_median"),
                "level_error_p99": notes.get("level_error_p99"),
                "closed": statistics.closed, "genus": statistics.genus,
                "components": statistics.components, **scene.judged(mesh, reference),
            })  # fmt: skip
            _logger.info("%s", json.dumps(meshes[-1]))
    ratios = {error: vertex_ratio(meshes, error) for error in ERRORS}
    return {"reference_vertices": len(reference.vertices), "meshes": meshes, "vertex_ratio": ratios}


def vertex_ratio(meshes: Sequence[dict[str, Any]], error: str) -> list[float]:
    """Return, for each adaptive mesh, its vertices over those of a uniform mesh of equal error.

    The uniform counts are interpolated between two meshes, and extrapolated from the two nearest
    beyond them, on logarithmic axes. Infinite where no number of vertices would do.
    """
    uniform = sorted(
        (m["vertices"], m[error]) for m in meshes if m["spacing"] == "uniform"
    )  # fmt: skip
    log_count, log_error = np.log(np.array(uniform, np.float64)).T
    ratios = []
    for mesh in meshes:
        if mesh["spacing"] != "adaptive":
            continue
        wanted = float(np.log(mesh[error]))
        # The last segment whose left end is still worse than what is wanted.
        at = min(max(int((log_error > wanted).sum()) - 1, 0), len(log_error) - 2)
        slope = (log_error[at + 1] - log_error[at]) / (log_count[at + 1] - log_count[at])
        if slope >= 0:
            ratios.append(float("inf"))
            continue
        equal = log_count[at] + (wanted - log_error[at]) / slope
        ratios.append(float(np.exp(np.log(mesh["vertices"]) - equal)))
    return ratios


def _sampled_distances(mesh: SurfaceMesh, other: SurfaceMesh) -> np.ndarray:
    points, _ = sample_triangles(mesh.vertices, mesh.faces, SAMPLES, np.random.default_rng(0))
    return distances_to_mesh(points, other.vertices, other.faces)[0]


def open_scene(scene_folder: Path, gaussian_file: Path, *, threads: int) -> MeasuredScene:
    """Read cameras, region (automatic where none lies there), truth and Gaussians."""
    with tempfile.TemporaryDirectory(prefix="gwrap_spacing_") as work:
        scene = load_scene(scene_folder, Path(work), Progress(), seed=0, threads=threads)
    region_file = scene_folder / "region.json"
    if region_file.exists():
        region = parse_region(read_json(region_file), region_file)
        region = region.transformed(scene.world_from_scene.inverse())
    else:
        region = automatic_region(scene)
    truth = read_truth(scene_folder) if (scene_folder / "truth.npz").exists() else None
    return MeasuredScene(
        load_gaussians(gaussian_file), scene.cameras, region, threads=threads, truth=truth,
        world_from_scene=scene.world_from_scene,
    )  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure one scene and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("gaussians", type=Path)
    parser.add_argument("--points", type=int, nargs="+", default=[6000, 12_000, 24_000])
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    scene = open_scene(options.scene, options.gaussians, threads=options.threads)
    figures = measure_spacings(scene, options.points)
    _logger.info("vertex ratio %s", json.dumps(figures["vertex_ratio"]))
    if options.out is not None:
        write_json(options.out, figures)


if __name__ == "__main__":
    main()
