# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh stage: mesh a region of a finished training and clean the mesh up."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...array_file import is_whole
from ...devices import CPU, DeviceChoice
from ...errors import MeshingError
from ...progress import Progress
from ...report_warning import ReportWarning
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import Stage, record_interrupted_time, run_stage
from .mesh_keys import mesh_key
from .region_field import load_region
from .region_meshing import TilesPlanned

if TYPE_CHECKING:
    from .region_field import RegionInputs

    Loader = Callable[[JobFile, str, Stage, Stage, DeviceChoice, int], RegionInputs]

_logger = logging.getLogger(__name__)

ON_PROCESSOR = DeviceChoice(CPU, "", "The GPU failed.")

DENSE_MESH = "dense.npz"
"""In a mesh stage: the mesh before decimation, if it was decimated; texture maps use it."""


def run_mesh(
    folder: JobFolder,
    job: JobFile,
    request: str,
    name: str,
    cameras: Stage,
    trained: Stage,
    progress: Progress,
    *,
    threads: int,
    device: DeviceChoice,
    load: Loader = load_region,
    tile_processes: int = 1,
    warnings: Sequence[ReportWarning] = (),
) -> Stage:
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
        Takes the place of :func:`load_region`, to keep what it loads.
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
        chosen: DeviceChoice,
        stage_folder: Path,
        progress: Progress,
        warnings: Sequence[ReportWarning],
    ) -> dict[str, Any]:
        import numpy as np

        from ...dataset.frames.scene_grid import snapped_length
        from ...devices.whole_views import with_renderer
        from ...field.depth_samples import DepthSamples, sample_depth_maps
        from ...mesh.mesh_file import save_mesh
        from ...meshing.checks.manifold_check import validate_manifold
        from ...meshing.checks.mesh_statistics import mesh_statistics
        from ...meshing.cleanup.clean_up import clean_up
        from ...meshing.cleanup.open_boundary import without_caps
        from ...regions.region import write_region
        from ...render.types.renderer import Renderer
        from .region_field import field_figures
        from .region_meshing import mesh_by_pivots_in_stage, mesh_in_stage, remove_tiles

        inputs = load(job, request, cameras, trained, chosen, threads)
        region, vacancy = inputs.region, inputs.field.vacancy

        def sampled() -> DepthSamples:
            def on(renderer: Renderer) -> DepthSamples:
                return sample_depth_maps(
                    inputs.gaussians, vacancy.cameras, lambda points: region.contains(points, 0.0),
                    progress.span(0.0, 0.15), threads=threads, renderer=renderer,
                )  # fmt: skip

            return with_renderer(vacancy.device, "Depth maps", on)

        if meshing.method == "pivots":
            alone = meshing.pivot_samples == "none"
            mesh, expected = mesh_by_pivots_in_stage(
                stage_folder, vacancy, inputs.arrays, vacancy.cameras, region, meshing,
                progress.span(0.15, 0.9), seed=job.settings.seed, threads=threads,
                depth_samples=None if alone else sampled(), warnings=warnings,
            )  # fmt: skip
        else:
            mesh, expected = mesh_in_stage(
                stage_folder, inputs.field, inputs.arrays, vacancy.cameras, region, meshing,
                progress.span(0.15, 0.9), seed=job.settings.seed, sampled=sampled,
                edge_length_scene=snapped_length(
                    meshing.edge_length / inputs.scene.world_from_scene.scale
                ),
                warnings=warnings,
            )  # fmt: skip
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
        write_region(stage_folder / "region.json", inputs.world_region)
        progress.update(0.97, "measuring the mesh")
        return {
            "statistics": mesh_statistics(mesh).to_json(),
            "check": validate_manifold(mesh.vertices, mesh.faces, open_at).to_json(),
            "provenance": mesh.provenance,
            "edge_length_world": meshing.edge_length,
            "estimate": expected,
        }

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        from ...devices.failures import is_device_failure
        from .region_meshing import remove_tiles

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
            spent_s = time.monotonic() - begun_s
            record_interrupted_time(folder.stages, f"mesh-{name}", key, spent_s)
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
