# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh a region in its stage folder, whole or in tiles, as requested or as memory allows.

Tiles are parts of a job, which other processes may make (:mod:`..parts`): a region in tiles is
planned here, and joined here once its tiles are there.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...progress import Progress
from ...settings import MeshingSettings

if TYPE_CHECKING:
    from ...dataset.camera import Camera
    from ...field.depth_samples import DepthSamples
    from ...field.vacancy.vacancy import VacancyField
    from ...gaussians.model import GaussianArrays
    from ...mesh.surface_mesh import SurfaceMesh
    from ...meshing.cost.mesh_estimate import MeshEstimate
    from ...meshing.cost.pivot_estimate import PivotEstimate
    from ...meshing.tiles.plan import Field
    from ...regions.convex_region import Region
    from ...report_warning import ReportWarning

_logger = logging.getLogger(__name__)

TILES_FOLDER = "tiles"
"""Subfolder of the stage's folder while tiles are being meshed."""

MAX_SPACING_SAMPLES = 5_000
"""Approximate number of depth samples at which the resolution of the photos is evaluated."""


class TilesPlanned(Exception):  # noqa: N818 - no error: the tiles are made next
    """A region is planned in tiles, some of which are not made yet."""

    def __init__(self, stage_folder: Path) -> None:
        super().__init__(stage_folder)
        self.stage_folder = stage_folder


def mesh_in_stage(
    stage_folder: Path,
    field: Field,
    arrays: GaussianArrays,
    cameras: Sequence[Camera],
    region: Region,
    meshing: MeshingSettings,
    progress: Progress,
    *,
    seed: int,
    edge_length_scene: float,
    sampled: Callable[[], DepthSamples],
    warnings: Sequence[ReportWarning] = (),
) -> tuple[SurfaceMesh, dict[str, Any]]:
    """Estimate the mesh of a region, then make it; or plan its tiles; or join them.

    Parameters
    ----------
    sampled : callable
        Samples depth maps; not called where tiles are planned already.
    warnings : sequence of ReportWarning
        Of the plan, for the report.

    Returns
    -------
    mesh : SurfaceMesh
    expected : dict
        The estimate, for the report.

    Raises
    ------
    TilesPlanned
        Tiles are to be made first.
    ResourceError
        The mesh does not fit into memory.
    MeshingError
        The region holds no surface.
    """
    from ...meshing.primal_adaptive import mesh_region
    from ...meshing.tiles.store import is_planned, save_plan
    from ...meshing.tiles.tiled_mesh import plan_tiles

    folder = stage_folder / TILES_FOLDER
    if is_planned(folder):
        return _joined(stage_folder, field, meshing, progress)
    depth_samples = sampled()
    expected = estimate_region_mesh(
        field.vacancy, cameras, region, meshing, edge_length_scene, depth_samples
    )
    for line in expected.lines():
        _logger.info("region %s, estimated %s", region.name, line)
    memory_bytes = free_bytes(stage_folder, field.threads)
    tiled = meshing.tiles != "off" and (
        meshing.tiles != "auto" or bool(expected.tiles_for(memory_bytes))
    )
    expected.refuse(memory_bytes, tiled=tiled)
    told = {**expected.to_json(), "free_memory_bytes": memory_bytes, "tiled": tiled}
    if tiled:
        tiles = 0 if meshing.tiles == "auto" else int(meshing.tiles)
        plan = plan_tiles(
            field, arrays, cameras, region, meshing, progress, tiles=tiles, seed=seed,
            edge_length_scene=edge_length_scene, depth_samples=depth_samples,
        )  # fmt: skip
        noted = {"estimate": told, "warnings": [warning.to_json() for warning in warnings]}
        save_plan(folder, plan, noted)
        raise TilesPlanned(stage_folder)
    mesh = mesh_region(
        field.vacancy, field.vectors, arrays, cameras, region, meshing, progress, seed=seed,
        threads=field.threads, edge_length_scene=edge_length_scene, depth_samples=depth_samples,
    )  # fmt: skip
    _note(mesh, warnings)
    return mesh, told


def _note(mesh: SurfaceMesh, warnings: Sequence[ReportWarning]) -> None:
    if warnings:
        before = mesh.provenance.get("warnings", [])
        mesh.provenance["warnings"] = [*before, *(warning.to_json() for warning in warnings)]


def _joined(
    stage_folder: Path, field: Field, meshing: MeshingSettings, progress: Progress
) -> tuple[SurfaceMesh, dict[str, Any]]:
    """Join the tiles of a planned region.

    Raises
    ------
    TilesPlanned
        Some are missing.
    """
    from ...meshing.tiles.store import (
        faces_path,
        gathered_path,
        load_plan,
        load_point_figures,
        load_surface,
    )
    from ...meshing.tiles.tiled_mesh import join_tiles

    folder = stage_folder / TILES_FOLDER
    plan, noted = load_plan(folder)
    paths = [faces_path(folder, tile) for tile in range(len(plan.tiling))]
    if not all(path.is_file() for path in [gathered_path(folder), *paths]):
        raise TilesPlanned(stage_folder)
    mesh = join_tiles(
        field, plan, load_point_figures(gathered_path(folder)),
        lambda tile: load_surface(paths[tile]), meshing, progress,
    )  # fmt: skip
    if noted.get("warnings"):
        mesh.provenance["warnings"] = list(noted["warnings"])
    return mesh, dict(noted.get("estimate", {}))


def mesh_by_pivots_in_stage(
    stage_folder: Path,
    vacancy: VacancyField,
    arrays: GaussianArrays,
    cameras: Sequence[Camera],
    region: Region,
    meshing: MeshingSettings,
    progress: Progress,
    *,
    seed: int,
    threads: int,
    depth_samples: DepthSamples | None,
    warnings: Sequence[ReportWarning] = (),
) -> tuple[SurfaceMesh, dict[str, Any]]:
    """Estimate the mesh of a region by pivots, then make it; see :func:`mesh_in_stage`."""
    from ...meshing.pivot_meshing import mesh_by_pivots

    expected = estimate_region_pivots(vacancy, arrays, region, meshing, depth_samples)
    for line in expected.lines():
        _logger.info("region %s, estimated %s", region.name, line)
    memory_bytes = free_bytes(stage_folder, threads)
    expected.refuse(memory_bytes)
    mesh = mesh_by_pivots(
        vacancy, arrays, cameras, region, meshing, progress, seed=seed, depth_samples=depth_samples
    )
    _note(mesh, warnings)
    return mesh, {**expected.to_json(), "free_memory_bytes": memory_bytes, "tiled": False}


def estimate_region_pivots(
    vacancy: VacancyField,
    arrays: GaussianArrays,
    region: Region,
    meshing: MeshingSettings,
    depth_samples: DepthSamples | None,
) -> PivotEstimate:
    """Estimate the mesh of a region by pivots from the Gaussians and depth samples in it."""
    from ...meshing.cost.mesh_estimate import evaluation_seconds
    from ...meshing.cost.pivot_estimate import estimate_pivot_mesh

    if depth_samples is None:
        samples, near = 0, arrays.means[region.contains(arrays.means, 0.0)]
    else:
        samples, near = len(depth_samples), depth_samples.points
    return estimate_pivot_mesh(
        arrays, region, meshing.pivots, samples,
        box=meshing.pivot_box, alone=meshing.pivot_samples == "none",
        evaluation_s=evaluation_seconds(vacancy, near),
    )  # fmt: skip


def estimate_region_mesh(
    vacancy: VacancyField,
    cameras: Sequence[Camera],
    region: Region,
    meshing: MeshingSettings,
    edge_length_scene: float,
    depth_samples: DepthSamples,
) -> MeshEstimate:
    """Estimate the mesh of a region from the depth samples of its surface."""
    from ...meshing.cost.mesh_estimate import (
        box_counting_area,
        estimate_mesh,
        evaluation_seconds,
        occupied_boundary_area,
    )
    from ...meshing.points.resolution import checked_request
    from ...meshing.points.spacing import resolved_edges

    adaptive = meshing.spacing == "adaptive"
    subset = depth_samples.points[:: max(1, len(depth_samples) // MAX_SPACING_SAMPLES)]
    return estimate_mesh(
        box_counting_area(depth_samples.points),
        occupied_boundary_area(region, vacancy.is_empty),
        checked_request(edge_length_scene, meshing.points, region),
        adaptive=adaptive,
        evaluation_s=evaluation_seconds(vacancy, depth_samples.points),
        resolved=resolved_edges(subset, cameras) if adaptive else None,
    )


def free_bytes(folder: Path, threads: int) -> int:
    """Return how much memory a mesh may use on this machine; 0 if unknown."""
    from ...training.cost.training_estimate import MEMORY_SHARE_LEFT, this_machine

    return int(MEMORY_SHARE_LEFT * this_machine(folder, threads).memory_bytes)


def remove_tiles(stage_folder: Path) -> None:
    """Remove the tile files once the mesh is saved."""
    folder = stage_folder / TILES_FOLDER
    if not folder.is_dir():
        return
    aside = stage_folder / f"{TILES_FOLDER}-joined"
    try:
        os.replace(folder, aside)  # atomic: no process finds a partly deleted list
    except OSError:
        aside = folder
    shutil.rmtree(aside, ignore_errors=True)
