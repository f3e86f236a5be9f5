# SPDX-License-Identifier: GPL-3.0-or-later
"""The stage of the meshes: field of a region, mesh in one piece or in tiles."""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...array_file import is_whole
from ...devices import CPU, DeviceChoice, stage_device
from ...devices.checks import is_device_failure, with_renderer
from ...errors import DatasetError, MeshingError, WrapError
from ...field import cuda_vacancy, samples
from ...field.samples import DepthSamples
from ...field.vacancy import PackedMask, VacancyField
from ...field.vector_field import VectorField
from ...gaussians.files import load_gaussians
from ...gaussians.model import GaussianArrays, OrientedGaussians, without_blur
from ...mesh.surface_mesh import SurfaceMesh, save_mesh
from ...meshing import estimate, pivot_meshing
from ...meshing.checks import mesh_statistics, validate_manifold
from ...meshing.clean_up import clean_up, without_caps
from ...meshing.primal_adaptive import mesh_region
from ...meshing.spacing import checked_request, resolved_edges
from ...meshing.surface_points import Field, halo_bounds
from ...meshing.tiles import store as tile_store
from ...meshing.tiles.plan import TilePlan
from ...meshing.tiles.tile import GatheredPoints, gather, tile_faces, tile_points, tile_surface
from ...meshing.tiles.tiled_mesh import join_tiles, plan_tiles
from ...names import AUTOMATIC_REGIONS, GATHER, POINTS, TILE_KINDS
from ...photos.store import PhotoStore
from ...progress import Progress, ReportWarning
from ...regions import scene_regions
from ...regions.shapes import Region
from ...render.types import Renderer
from ...scene import scene as scene_files
from ...scene.frames import snapped_length
from ...scene.scene import PhotoSource, Scene
from ...settings import MeshingSettings, TrainingSettings, key_values
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import (
    STAGE_VERSIONS,
    Stage,
    record_interrupted_time,
    run_stage,
    stage_key,
)

if TYPE_CHECKING:
    from ...meshing.estimate import MeshEstimate, PivotEstimate


# -- Keys of a job's mesh stages ------------------------------------------------------------------


def mesh_key(job: JobFile, request: str, name: str, trained_key: str) -> str:
    """Return the key of a region's mesh stage: the hash of everything its mesh depends on."""
    body = job.region_bodies.get(request)
    return stage_key(
        STAGE_VERSIONS["mesh"], trained_key, request if body is None else body, name,
        key_values(job.meshing_of(request)), job.settings.seed,
    )  # fmt: skip


# -- Build the vacancy field of a region with the job's cameras, masks and unseen space -----------

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RegionInputs:
    """What the mesh of a region is made from."""

    scene: Scene
    gaussians: OrientedGaussians
    arrays: GaussianArrays
    region: Region
    """Scene frame."""
    world_region: Region
    field: Field


def load_region(
    job: JobFile, request: str, cameras: Stage, trained: Stage, device: DeviceChoice, threads: int
) -> RegionInputs:
    """Load a finished training and build the field of a region from it.

    ``request`` is the region's entry in the job's settings; vacancy is evaluated on ``device``, if
    it fits there. Raises ParseError, DatasetError: a file of the stages is damaged or missing;
    DeviceError: as :func:`~.choice.stage_device`.
    """
    scene = scene_files.load_refined_scene(cameras.folder, trained.folder)
    trained_ones = load_gaussians(trained.folder / "gaussians.npz")
    whole = trained_ones.arrays() if request == "all" else None
    region, world_region = requested_region(request, job.region_bodies.get(request), scene, whole)
    training, meshing = job.settings.training, job.meshing_of(request)
    gaussians = without_blur(trained_ones, meshing.blur_variance, training.filter_variance)
    arrays = gaussians.arrays()
    if device.is_cuda:
        needed = cuda_vacancy.needed_bytes(len(arrays))
        device = stage_device(device, job.settings.device, needed, "Vacancy")
    vacancy = region_field(
        scene, arrays, region, training, meshing, threads=threads, device=device.device
    )
    field = Field(vacancy, VectorField(arrays, threads=threads), threads)
    return RegionInputs(scene, gaussians, arrays, region, world_region, field)


def requested_region(
    request: str, body: Any, scene: Scene, arrays: GaussianArrays | None
) -> tuple[Region, Region]:
    """Return the requested region in the scene frame, on its grid, and in the world frame.

    The world-frame region of a file is returned as read: transforming it to the scene frame and
    back would change its last digits each time.

    Parameters
    ----------
    request : str
        ``"auto"``, ``"all"`` or the path of a region file.
    body : object
        Content of that file.
    arrays : GaussianArrays, optional
        Of the training; only the region ``"all"`` needs them.
    """
    if request not in AUTOMATIC_REGIONS:
        world_region = scene_regions.parse_region(body, Path(request))
        return scene_regions.region_in_scene(world_region, scene.world_from_scene), world_region
    if request == "auto":
        region = scene_regions.automatic_region(scene)
    else:
        assert arrays is not None
        region = scene_regions.whole_region(scene, arrays)
    region = scene_regions.on_scene_grid(region)
    return region, region.transformed(scene.world_from_scene)


def reject_short_edges(job: JobFile, cameras: Stage) -> None:
    """Refuse edges far too short for their region, which would else fail after the training.

    The region of all Gaussians is known only then, and is left out. Raises ResourceError.
    """
    lengths = {
        request: meshing.edge_length
        for request in job.settings.regions
        if (meshing := job.meshing_of(request)).method == "pam" and request != "all"
    }
    if not any(lengths.values()):
        return
    scene = scene_files.load_saved_scene(cameras.folder)
    for request, length in lengths.items():
        region, _ = requested_region(request, job.region_bodies.get(request), scene, None)
        checked_request(length / scene.world_from_scene.scale, 0, region)


def field_views(scene: Scene, photos: PhotoSource, holdout_every: int, cameras: str) -> list[int]:
    """Return the views whose cameras a mesh is made from (docs/method.md, section 5.3).

    ``cameras``: setting of the meshing: ``"training"`` leaves out held-out photos and photos that
    their masks cover; ``"all"`` uses every camera.
    Raises DatasetError: no camera is left.
    """
    if cameras == "all":
        return list(range(len(scene.views)))
    views = scene_files.training_views(scene, photos, holdout_every)
    if not views:
        raise DatasetError(
            "The masks cover every photo that was trained on.",
            "Check the masks, or mesh with the cameras of all photos.",
        )
    return views


def region_field(
    scene: Scene, arrays: GaussianArrays, region: Region, training: TrainingSettings,
    meshing: MeshingSettings, *, threads: int, device: str = "cpu",
) -> VacancyField:  # fmt: skip
    """Return the field in and around a region (scene frame), limited to the mesher's halo.

    If the kernels of a GPU cannot run, it is evaluated on the processor and the log says why.
    Raises DatasetError: a mask does not fit its photo, or masks cover all photos of the training.
    """
    photos = PhotoStore(scene, training.max_image_px)
    views = field_views(scene, photos, training.holdout_every, meshing.cameras)
    cameras = [scene.views[index].camera for index in views]
    options: dict[str, Any] = {
        "threads": threads,
        "unseen": meshing.unseen,
        "level": meshing.level,
        "region_bounds": halo_bounds(region),
        "masks": [PackedMask.of(photos.mask(index)) for index in views],
        "mask_mode": scene.mask_mode(training.mask_mode),
    }
    if device.startswith("cuda"):
        try:
            return cuda_vacancy.CudaVacancyField(arrays, cameras, device=device, **options)
        except (WrapError, RuntimeError) as error:
            if not is_device_failure(error):
                raise
            reason = getattr(error, "message", error)
            _logger.warning("Vacancy is evaluated on the processor, not on the GPU: %s", reason)
    return VacancyField(arrays, cameras, **options)


def field_figures(field: VacancyField) -> dict[str, Any]:
    """Return the report's figures of a field: device, cameras, evaluations, what is unseen."""
    return {
        "field_device": field.device, "field_cameras": len(field.cameras), "unseen": field.unseen,
        "field_evaluations": field.evaluations, "unseen_evaluations": field.unseen_evaluations,
    }  # fmt: skip


# -- Mesh a region in its stage folder, whole or in tiles, as requested or as memory allows -------
#
# Tiles are parts of a job, which other processes may make (:mod:`..parts`): a region in tiles is
# planned here, and joined here once its tiles are there.

TILES_FOLDER = "tiles"
"""Subfolder of the stage's folder while tiles are being meshed."""

MAX_SPACING_SAMPLES = 5_000
"""Approximate number of depth samples at which the resolution of the photos is evaluated."""


class TilesPlanned(Exception):  # noqa: N818 - no error: the tiles are made next
    """A region is planned in tiles, some of which are not made yet."""

    def __init__(self, stage_folder: Path) -> None:
        super().__init__(stage_folder)
        self.stage_folder = stage_folder


def _mesh_in_stage(
    stage_folder: Path, inputs: RegionInputs, meshing: MeshingSettings, progress: Progress, *,
    seed: int, sampled: Callable[[], DepthSamples], warnings: Sequence[ReportWarning],
) -> tuple[SurfaceMesh, dict[str, Any]]:  # fmt: skip
    """Estimate the mesh of a region, then make it; or plan its tiles; or join them.

    Return the mesh and the estimate. Raise :class:`TilesPlanned` where tiles are to be made first.
    """
    folder, field, region = stage_folder / TILES_FOLDER, inputs.field, inputs.region
    cameras = field.vacancy.cameras
    if tile_store.is_planned(folder):
        return _joined(stage_folder, field, meshing, progress)
    edge_length_scene = snapped_length(meshing.edge_length / inputs.scene.world_from_scene.scale)
    depth_samples = sampled()
    expected = estimate_region_mesh(
        field.vacancy, region, meshing, edge_length_scene, depth_samples
    )
    memory_bytes = _log_estimate(expected, region, stage_folder)
    tiled = meshing.tiles != "off" and (
        meshing.tiles != "auto" or bool(expected.tiles_for(memory_bytes))
    )
    expected.refuse(memory_bytes, tiled=tiled)
    told = {**expected.to_json(), "free_memory_bytes": memory_bytes, "tiled": tiled}
    if tiled:
        tiles = 0 if meshing.tiles == "auto" else int(meshing.tiles)
        plan = plan_tiles(
            field, inputs.arrays, cameras, region, meshing, progress, tiles=tiles, seed=seed,
            edge_length_scene=edge_length_scene, depth_samples=depth_samples,
        )  # fmt: skip
        noted = {"estimate": told, "warnings": [warning.to_json() for warning in warnings]}
        tile_store.save_plan(folder, plan, noted)
        raise TilesPlanned(stage_folder)
    mesh = mesh_region(
        field, inputs.arrays, cameras, region, meshing, progress, seed=seed,
        edge_length_scene=edge_length_scene, depth_samples=depth_samples,
    )  # fmt: skip
    _note(mesh, warnings)
    return mesh, told


def _log_estimate(expected: MeshEstimate | PivotEstimate, region: Region, folder: Path) -> int:
    """Log an estimate; return how much memory is free for the mesh."""
    for line in expected.lines():
        _logger.info("region %s, estimated %s", region.name, line)
    return free_bytes(folder)


def _note(mesh: SurfaceMesh, warnings: Sequence[ReportWarning]) -> None:
    if warnings:
        before = mesh.provenance.get("warnings", [])
        mesh.provenance["warnings"] = [*before, *(warning.to_json() for warning in warnings)]


def _joined(
    stage_folder: Path, field: Field, meshing: MeshingSettings, progress: Progress
) -> tuple[SurfaceMesh, dict[str, Any]]:
    """Join the tiles of a planned region, or raise ``TilesPlanned`` where some are missing."""
    folder = stage_folder / TILES_FOLDER
    plan, noted = tile_store.load_plan(folder)
    paths = [tile_store.faces_path(folder, tile) for tile in range(len(plan.tiling))]
    gathered = tile_store.gathered_path(folder)
    if not all(path.is_file() for path in [gathered, *paths]):
        raise TilesPlanned(stage_folder)
    mesh = join_tiles(
        field, plan, tile_store.load_point_figures(gathered),
        lambda tile: tile_store.load_surface(paths[tile]), meshing, progress,
    )  # fmt: skip
    if noted.get("warnings"):
        mesh.provenance["warnings"] = list(noted["warnings"])
    return mesh, dict(noted.get("estimate", {}))


def mesh_by_pivots_in_stage(
    stage_folder: Path, field: Field, arrays: GaussianArrays, region: Region,
    meshing: MeshingSettings, progress: Progress, *, seed: int, depth_samples: DepthSamples | None,
) -> tuple[SurfaceMesh, dict[str, Any]]:  # fmt: skip
    """Estimate the mesh of a region by pivots, then make it; return both."""
    vacancy = field.vacancy
    expected = estimate_region_pivots(vacancy, arrays, region, meshing, depth_samples)
    memory_bytes = _log_estimate(expected, region, stage_folder)
    expected.refuse(memory_bytes)
    mesh = pivot_meshing.mesh_by_pivots(
        vacancy, arrays, vacancy.cameras, region, meshing, progress, seed=seed,
        depth_samples=depth_samples,
    )  # fmt: skip
    return mesh, {**expected.to_json(), "free_memory_bytes": memory_bytes, "tiled": False}


def estimate_region_pivots(
    vacancy: VacancyField, arrays: GaussianArrays, region: Region, meshing: MeshingSettings,
    depth_samples: DepthSamples | None,
) -> PivotEstimate:  # fmt: skip
    """Estimate the mesh of a region by pivots from the Gaussians and depth samples in it."""
    if depth_samples is None:
        count, near = 0, arrays.means[region.contains(arrays.means, 0.0)]
    else:
        count, near = len(depth_samples), depth_samples.points
    return estimate.estimate_pivot_mesh(
        arrays, region, meshing.pivots, count,
        box=meshing.pivot_box, alone=meshing.pivot_samples == "none",
        evaluation_s=estimate.evaluation_seconds(vacancy, near),
    )  # fmt: skip


def estimate_region_mesh(
    vacancy: VacancyField, region: Region, meshing: MeshingSettings, edge_length_scene: float,
    depth_samples: DepthSamples,
) -> MeshEstimate:  # fmt: skip
    """Estimate the mesh of a region from the depth samples of its surface."""
    adaptive = meshing.spacing == "adaptive"
    subset = depth_samples.points[:: max(1, len(depth_samples) // MAX_SPACING_SAMPLES)]
    return estimate.estimate_mesh(
        estimate.box_counting_area(depth_samples.points),
        estimate.occupied_boundary_area(region, vacancy.is_empty),
        checked_request(edge_length_scene, meshing.points, region),
        adaptive=adaptive,
        evaluation_s=estimate.evaluation_seconds(vacancy, depth_samples.points),
        resolved=resolved_edges(subset, vacancy.cameras) if adaptive else None,
    )


def free_bytes(folder: Path) -> int:
    """Return how much memory a mesh may use on this machine; 0 if unknown."""
    from ...training.estimate import MEMORY_SHARE_LEFT, this_machine

    return int(MEMORY_SHARE_LEFT * this_machine(folder).memory_bytes)


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


# -- The parts of a tiled mesh: points of a tile, all points, faces of a tile ---------------------


def tile_file(folder: Path, kind: str, tile: int) -> Path:
    """Return the file that a part of a tiled mesh makes."""
    if kind == GATHER:
        return tile_store.gathered_path(folder)
    return (tile_store.points_path if kind == POINTS else tile_store.faces_path)(folder, tile)


class TileMaker:
    """Makes the parts of one planned region; each can be made again, with the same result."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @cached_property
    def _plan(self) -> TilePlan:
        return tile_store.load_plan(self._folder)[0]

    @cached_property
    def _all_points(self) -> GatheredPoints:
        return tile_store.load_gathered(tile_store.gathered_path(self._folder))

    def make_all(self, field: Field, progress: Progress) -> None:
        """Make all parts that are missing, one after another."""
        tiles = range(len(self._plan.tiling))
        todo = [(k, tile) for k in TILE_KINDS for tile in tiles if k != GATHER or tile == 0]
        for number, (kind, tile) in enumerate(todo):
            if not tile_file(self._folder, kind, tile).is_file():
                span = progress.span(number / len(todo), (number + 1) / len(todo))
                self.make(kind, tile, field, span)

    def make(self, kind: str, tile: int, field: Field, progress: Progress) -> Path:
        """Make a part and return its file."""
        path, plan = tile_file(self._folder, kind, tile), self._plan
        if kind == POINTS:
            tile_store.save_points(path, tile_points(field, plan, tile, progress))
        elif kind == GATHER:
            progress.update(0.0, "bringing the tiles' points together")
            files = [tile_file(self._folder, POINTS, n) for n in range(len(plan.tiling))]
            tile_store.save_gathered(path, gather(plan, [tile_store.load_points(f) for f in files]))
        else:
            faces = tile_faces(field, plan, self._all_points, tile, progress.span(0.0, 0.9))
            tile_store.save_surface(path, tile_surface(plan, self._all_points, faces))
        return path


# -- Mesh stage: mesh a region of a finished training and clean the mesh up -----------------------

ON_PROCESSOR = DeviceChoice(CPU, "", "The GPU failed.")

DENSE_MESH = "dense.npz"
"""In a mesh stage: the mesh before decimation, if it was decimated; texture maps use it."""


def run_mesh(
    folder: JobFolder, job: JobFile, request: str, name: str, trained: Stage, progress: Progress, *,
    device: DeviceChoice, load: Callable[[DeviceChoice], RegionInputs], tile_processes: int = 1,
    warnings: Sequence[ReportWarning] = (),
) -> Stage:  # fmt: skip
    """Mesh a region, or plan or join its tiles, or re-use its finished mesh stage.

    Parameters
    ----------
    request : str
        The region's entry in the job's settings.
    name : str
        Name of the region's folder.
    device : DeviceChoice
        The job's; vacancy is evaluated and depth maps are rendered there. Everything else gets
        arrays and CPU tensors.
    load : callable
        Returns what :func:`load_region` does for a device.
    tile_processes : int
        How many processes made the tiles, for the report.
    warnings : sequence of ReportWarning
        Of what was tried before.

    Raises
    ------
    TilesPlanned
        The region is planned in tiles, which are to be made before this is called again.
    MeshingError, ResourceError
        The region holds no surface, or its mesh does not fit into memory.
    """
    meshing = job.meshing_of(request)
    key = mesh_key(job, request, name, trained.key)

    def meshed(
        chosen: DeviceChoice, stage_folder: Path, progress: Progress,
        warnings: Sequence[ReportWarning],
    ) -> dict[str, Any]:  # fmt: skip
        inputs = load(chosen)
        region, vacancy = inputs.region, inputs.field.vacancy

        def sampled() -> DepthSamples:
            def on(renderer: Renderer) -> DepthSamples:
                return samples.sample_depth_maps(
                    inputs.gaussians, vacancy.cameras, lambda points: region.contains(points, 0.0),
                    progress.span(0.0, 0.15), threads=inputs.field.threads,
                    renderer=renderer,
                )  # fmt: skip

            return with_renderer(vacancy.device, "Depth maps", on)

        seed, span = job.settings.seed, progress.span(0.15, 0.9)
        if meshing.method == "pivots":
            mesh, expected = mesh_by_pivots_in_stage(
                stage_folder, inputs.field, inputs.arrays, region, meshing, span, seed=seed,
                depth_samples=None if meshing.pivot_samples == "none" else sampled(),
            )  # fmt: skip
            _note(mesh, warnings)
        else:
            mesh, expected = _mesh_in_stage(
                stage_folder, inputs, meshing, span, seed=seed, sampled=sampled, warnings=warnings
            )
        if expected.get("tiled"):
            mesh.provenance["tile_processes"] = tile_processes
        mesh, dense = clean_up(mesh, region, meshing, vacancy, progress.span(0.9, 0.97))
        open_at = region if meshing.boundary == "open" else None
        if open_at is not None:
            mesh = without_caps(mesh, open_at, meshing.min_component_share)
            if dense is not None:
                dense = without_caps(dense, open_at, meshing.min_component_share)
        mesh.provenance.update(field_figures(vacancy), cameras=meshing.cameras)
        if not np.isfinite(mesh.vertices).all():
            raise MeshingError(
                "The mesh has vertices that are not finite.",
                "Send the job folder's log.txt with a bug report.",
            )
        save_mesh(stage_folder / "mesh.npz", mesh)
        if dense is not None:
            save_mesh(stage_folder / DENSE_MESH, dense)
        remove_tiles(stage_folder)
        scene_regions.write_region(stage_folder / "region.json", inputs.world_region)
        progress.update(0.97, "measuring the mesh")
        return {
            "statistics": mesh_statistics(mesh).to_json(),
            "check": validate_manifold(mesh.vertices, mesh.faces, open_at).to_json(),
            "provenance": mesh.provenance,
            "edge_length_world": meshing.edge_length,
            "estimate": expected,
        }

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        begun_s = time.monotonic()
        try:
            try:
                return meshed(device, stage_folder, progress, warnings)
            except Exception as error:
                if not (device.is_cuda and is_device_failure(error)):
                    raise
                failed = device_warning(device, name, error)
            # Tiles of two devices differ by rounding where they join.
            remove_tiles(stage_folder)
            return meshed(ON_PROCESSOR, stage_folder, progress, [*warnings, failed])
        except TilesPlanned:
            record_interrupted_time(stage_folder, time.monotonic() - begun_s)
            raise

    def whole(stage_folder: Path) -> bool:
        dense = stage_folder / DENSE_MESH
        return is_whole(stage_folder / "mesh.npz") and (not dense.exists() or is_whole(dense))

    return run_stage(folder.stages, f"mesh-{name}", key, progress, work, whole=whole)


def device_warning(device: DeviceChoice, name: str, error: Exception) -> ReportWarning:
    """Return the warning that a region is meshed on the processor, and log it."""
    warning = ReportWarning(
        "device-failed",
        f"{device.device} failed while region {name!r} was meshed "
        f"({getattr(error, 'message', error)}); it was meshed again on the processor.",
        "Close other programs that use the GPU.",
    )
    _logger.warning("%s", warning.text)
    return warning
