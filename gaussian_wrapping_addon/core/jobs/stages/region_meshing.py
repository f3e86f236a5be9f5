# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh a region in its stage folder, whole or in tiles, as requested or as memory allows."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import MeshingError
from ...progress import Progress
from ...settings import JobSettings, MeshingSettings, from_json, to_json
from ..store.claims import Claims, run_tasks
from ..store.job_file import read_job
from ..store.job_folder import JobFolder
from ..store.stage_folder import read_done
from .mesh_keys import mesh_stages

if TYPE_CHECKING:
    from ...dataset.camera import Camera
    from ...field.depth_samples import DepthSamples
    from ...field.vacancy.vacancy import VacancyField
    from ...field.vector_field import VectorField
    from ...gaussians.model import GaussianArrays
    from ...mesh.surface_mesh import SurfaceMesh
    from ...meshing.cost.mesh_estimate import MeshEstimate
    from ...meshing.cost.pivot_estimate import PivotEstimate
    from ...meshing.tiles.plan import Field
    from ...regions.convex_region import Region

_logger = logging.getLogger(__name__)

TILES_FOLDER = "tiles"
"""Subfolder of the stage's folder while tiles are being meshed."""

CLAIMS_FOLDER = "claims"

MAX_SPACING_SAMPLES = 5_000
"""Approximate number of depth samples at which the resolution of the photos is evaluated."""


def mesh_in_stage(
    stage_folder: Path,
    vacancy: VacancyField,
    vectors: VectorField,
    arrays: GaussianArrays,
    cameras: Sequence[Camera],
    region: Region,
    meshing: MeshingSettings,
    progress: Progress,
    *,
    seed: int,
    threads: int,
    edge_length_scene: float,
    depth_samples: DepthSamples,
    origin: dict[str, Any],
) -> tuple[SurfaceMesh, dict[str, Any]]:
    """Estimate the mesh of a region, then make it, whole or in tiles.

    Returns
    -------
    mesh : SurfaceMesh
    expected : dict
        The estimate, for the report.

    Raises
    ------
    ResourceError
        The mesh does not fit into memory.
    MeshingError
        The region holds no surface.
    """
    from ...meshing.primal_adaptive import mesh_region
    from ...meshing.tiles.plan import Field
    from ...meshing.tiles.store import LIST_NAME

    expected = estimate_region_mesh(
        vacancy, cameras, region, meshing, edge_length_scene, depth_samples
    )
    for line in expected.lines():
        _logger.info("region %s, estimated %s", region.name, line)
    memory_bytes = free_bytes(stage_folder, threads)
    begun = (stage_folder / TILES_FOLDER / LIST_NAME).is_file()
    tiled = meshing.tiles != "off" and (
        meshing.tiles != "auto" or begun or expected.tiles_for(memory_bytes)
    )
    expected.refuse(memory_bytes, tiled=tiled)
    if tiled:
        mesh = mesh_tiled_in_stage(
            stage_folder, Field(vacancy, vectors, threads), arrays, cameras, region, meshing,
            progress, tiles=0 if meshing.tiles == "auto" else int(meshing.tiles), seed=seed,
            edge_length_scene=edge_length_scene, depth_samples=depth_samples, origin=origin,
        )  # fmt: skip
    else:
        mesh = mesh_region(
            vacancy, vectors, arrays, cameras, region, meshing, progress, seed=seed,
            threads=threads, edge_length_scene=edge_length_scene, depth_samples=depth_samples,
        )  # fmt: skip
    return mesh, {**expected.to_json(), "free_memory_bytes": memory_bytes, "tiled": tiled}


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


def mesh_tiled_in_stage(
    stage_folder: Path,
    field: Field,
    arrays: GaussianArrays,
    cameras: Sequence[Camera],
    region: Region,
    meshing: MeshingSettings,
    progress: Progress,
    *,
    tiles: int,
    seed: int,
    edge_length_scene: float,
    depth_samples: DepthSamples | None,
    origin: dict[str, Any],
) -> SurfaceMesh:
    """Mesh a region tile by tile, alone or together with other processes.

    Finished tiles of an interrupted run are re-used.

    Parameters
    ----------
    tiles : int
        0 makes as many as the request needs.
    origin : dict
        From which other processes rebuild the same field (:func:`tiles_origin`).
    """
    from ...meshing.tiles.store import (
        LIST_NAME,
        faces_path,
        gathered_path,
        load_faces,
        load_gathered,
        load_plan,
        save_plan,
    )
    from ...meshing.tiles.tiled_mesh import join_tiles, plan_tiles
    from .tile_tasks import tile_tasks

    folder = stage_folder / TILES_FOLDER
    if not (folder / LIST_NAME).is_file():
        save_plan(
            folder,
            plan_tiles(
                field, arrays, cameras, region, meshing, progress.span(0.0, 0.2), tiles=tiles,
                seed=seed, edge_length_scene=edge_length_scene, depth_samples=depth_samples,
            ),
            origin,
        )  # fmt: skip
    plan, _ = load_plan(folder)
    claims = Claims(folder / CLAIMS_FOLDER)
    run_tasks(tile_tasks(folder, plan, field), claims, progress.span(0.2, 0.9))
    parts = [load_faces(faces_path(folder, tile)) for tile in range(len(plan.tiling))]
    all_points = load_gathered(gathered_path(folder))
    mesh = join_tiles(field, plan, all_points, parts, meshing, progress.span(0.9, 1.0))
    mesh.provenance["tile_processes"] = claims.worker_count()
    return mesh


def tiles_origin(cameras: Path, training: Path, settings: JobSettings) -> dict[str, Any]:
    """Return the inputs from which another process rebuilds the same field, as JSON values."""
    return {"cameras": cameras.name, "training": training.name, "settings": to_json(settings)}


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


def unfinished_tile_lists(folder: JobFolder) -> list[Path]:
    """Return the folders of the unfinished tile lists of the job in a folder.

    Lists of earlier jobs, which nothing will join, do not count. The job's worker need not be
    alive: another machine could not tell.
    """
    from ...meshing.tiles.store import LIST_NAME

    found = sorted(folder.stages.glob(f"mesh-*/{TILES_FOLDER}/{LIST_NAME}"))
    unfinished = [path.parent for path in found if read_done(path.parent.parent) is None]
    if not unfinished or folder.read_status().state == "DONE":
        return []
    own_stages = mesh_stages(folder, read_job(folder.job_path))
    return [path for path in unfinished if path.parent.name in own_stages]


def work_on_tile_list(
    stages: Path,
    folder: Path,
    progress: Progress,
    done_here: list[str],
    *,
    threads: int,
    device: str,
) -> None:
    """Work on a tile list in a separate process; append the names of completed tasks.

    Parameters
    ----------
    device : str
        The setting of this process.

    Raises
    ------
    ParseError, DatasetError
        A stage named by the list is not in the job folder.
    """
    from ...dataset.refined_scene import load_refined_scene
    from ...devices import choose_device
    from ...field.vector_field import VectorField
    from ...files import resolve_inside
    from ...gaussians.gaussian_file import load_gaussians
    from ...meshing.tiles.plan import Field
    from ...meshing.tiles.store import load_plan
    from .region_field import field_device, region_field
    from .tile_tasks import tile_tasks

    plan, origin = load_plan(folder)
    stage_folders = [
        resolve_inside(stages, str(origin.get(key, ""))) for key in ("cameras", "training")
    ]
    if None in stage_folders:
        raise MeshingError("The tile list names no stages of this job.", "Mesh the region again.")
    cameras, training = (stage for stage in stage_folders if stage is not None)
    scene = load_refined_scene(cameras, training)
    arrays = load_gaussians(training / "gaussians.npz").arrays()
    settings = from_json(JobSettings, origin.get("settings"), "settings").validated()
    vacancy = region_field(
        scene, arrays, plan.region, settings.training, settings.meshing, threads=threads,
        device=field_device(choose_device(device), device, arrays).device,
    )  # fmt: skip
    field = Field(vacancy, VectorField(arrays, threads=threads), threads)
    tasks = tile_tasks(folder, plan, field)
    run_tasks(tasks, Claims(folder / CLAIMS_FOLDER), progress, done_here=done_here)
