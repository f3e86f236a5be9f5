# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh stage: mesh a region of a finished training and clean the mesh up."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from ...array_file import is_whole
from ...devices import CPU, DeviceChoice
from ...errors import MeshingError
from ...progress import Progress
from ...report_warning import ReportWarning
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import Stage, run_stage
from .mesh_keys import mesh_key

_logger = logging.getLogger(__name__)

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
) -> Stage:
    """Mesh a region, or re-use its finished mesh stage.

    Parameters
    ----------
    request : str
        The region's entry in the job's settings.
    name : str
        Name of the region's folder.
    device : DeviceChoice
        The job's; vacancy is evaluated and depth maps are rendered there. Everything else gets
        arrays and CPU tensors.

    Raises
    ------
    MeshingError, ResourceError
        The region holds no surface, or its mesh does not fit into memory.
    """
    meshing = job.meshing_of(request)
    body = job.region_bodies.get(request)
    key = mesh_key(job, request, name, trained.key)

    def meshed(
        chosen: DeviceChoice, stage_folder: Path, progress: Progress, warnings: list[ReportWarning]
    ) -> dict[str, Any]:
        import numpy as np

        from ...dataset.frames.scene_grid import snapped_length
        from ...dataset.refined_scene import load_refined_scene
        from ...devices.whole_views import with_renderer
        from ...field.depth_samples import DepthSamples, sample_depth_maps
        from ...field.vector_field import VectorField
        from ...gaussians.gaussian_file import load_gaussians
        from ...mesh.mesh_file import save_mesh
        from ...meshing.checks.manifold_check import validate_manifold
        from ...meshing.checks.mesh_statistics import mesh_statistics
        from ...meshing.cleanup.clean_up import clean_up
        from ...meshing.cleanup.open_boundary import without_caps
        from ...regions.region import write_region
        from ...render.types.renderer import Renderer
        from .region_field import field_device, field_figures, region_field, requested_region
        from .region_meshing import (
            mesh_by_pivots_in_stage,
            mesh_in_stage,
            remove_tiles,
            tiles_origin,
        )

        scene = load_refined_scene(cameras.folder, trained.folder)
        gaussians = load_gaussians(trained.folder / "gaussians.npz")
        arrays = gaussians.arrays()
        region, world_region = requested_region(request, body, scene, arrays)
        vacancy = region_field(
            scene, arrays, region, job.settings.training, meshing, threads=threads,
            device=field_device(chosen, job.settings.device, arrays).device,
        )  # fmt: skip

        def sampled() -> DepthSamples:
            def on(renderer: Renderer) -> DepthSamples:
                return sample_depth_maps(
                    gaussians, vacancy.cameras, lambda points: region.contains(points, 0.0),
                    progress.span(0.0, 0.15), threads=threads, renderer=renderer,
                )  # fmt: skip

            return with_renderer(vacancy.device, "Depth maps", on)

        if meshing.method == "pivots":
            alone = meshing.pivot_samples == "none"
            mesh, expected = mesh_by_pivots_in_stage(
                stage_folder, vacancy, arrays, vacancy.cameras, region, meshing,
                progress.span(0.15, 0.9), seed=job.settings.seed, threads=threads,
                depth_samples=None if alone else sampled(),
            )  # fmt: skip
        else:
            mesh, expected = mesh_in_stage(
                stage_folder, vacancy, VectorField(arrays, threads=threads), arrays,
                vacancy.cameras, region, meshing, progress.span(0.15, 0.9),
                seed=job.settings.seed, threads=threads,
                edge_length_scene=snapped_length(
                    meshing.edge_length / scene.world_from_scene.scale
                ),
                depth_samples=sampled(),
                origin=tiles_origin(cameras.folder, trained.folder, job.settings),
            )  # fmt: skip
        mesh, dense = clean_up(mesh, region, meshing, vacancy, progress.span(0.9, 0.97))
        open_at = region if meshing.boundary == "open" else None
        if open_at is not None:
            mesh = without_caps(mesh, open_at, meshing.min_component_share)
            if dense is not None:
                dense = without_caps(dense, open_at, meshing.min_component_share)
        mesh.provenance.update(field_figures(vacancy), cameras=meshing.cameras)
        if warnings:
            mesh.provenance["warnings"] = [
                *mesh.provenance.get("warnings", []), *(warning.to_json() for warning in warnings)
            ]  # fmt: skip
        if not np.isfinite(mesh.vertices).all():
            raise MeshingError(
                "The mesh has vertices that are not finite.",
                "Send the job folder's log.txt with a bug report.",
            )
        save_mesh(stage_folder / "mesh.npz", mesh)
        if dense is not None:
            save_mesh(stage_folder / DENSE_MESH, dense)
        remove_tiles(stage_folder)
        write_region(stage_folder / "region.json", world_region)
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

        try:
            return meshed(device, stage_folder, progress, [])
        except Exception as error:
            if not (device.is_cuda and is_device_failure(error)):
                raise
            reason = getattr(error, "message", error)
        # Tiles of two devices differ by rounding where they join.
        remove_tiles(stage_folder)
        warning = ReportWarning(
            "device-failed",
            f"{device.device} failed while region {name!r} was meshed ({reason}); it was meshed "
            "again on the processor.",
            "Close other programs that use the GPU.",
        )
        _logger.warning("%s", warning.text)
        processor = DeviceChoice(CPU, "", "The GPU failed.")
        return meshed(processor, stage_folder, progress, [warning])

    def whole(stage_folder: Path) -> bool:
        dense = stage_folder / DENSE_MESH
        return is_whole(stage_folder / "mesh.npz") and (not dense.exists() or is_whole(dense))

    return run_stage(folder.stages, f"mesh-{name}", key, progress, work, whole=whole)
