# SPDX-License-Identifier: GPL-3.0-or-later
"""The one runner behind button and command line: cameras, train, mesh, texture, export."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import MeshingError
from ..export_formats import RESULT_FORMATS
from ..kernels.parallel import default_threads
from ..machine import describe_machine
from ..names import region_names
from ..processes.peak_memory import peak_memory_bytes
from ..progress import Progress, ProgressEvent
from ..settings import to_json
from .stages.mesh_keys import mesh_key
from .store.job_file import JobFile, reject_region_conflicts
from .store.job_folder import JobFolder
from .store.stage_folder import (
    STAGE_VERSIONS,
    Stage,
    read_done,
    run_stage,
    source_fingerprint,
    stage_key,
)

_logger = logging.getLogger(__name__)

# Shares of a job's time, for the overall bar: measured on the demo scene, 2 cores.
STAGE_SHARES = {"cameras": 0.12, "train": 0.60, "mesh": 0.14, "texture": 0.12, "export": 0.02}

DENSE_MESH = "dense.npz"
"""In a mesh stage whose mesh was decimated: the mesh before, for the texture stage's maps."""


@dataclass(frozen=True)
class _Span:
    """Part of the overall bar that belongs to one stage."""

    begin: float
    end: float


class _JobProgress:
    """Maps the fraction of each stage onto the whole job, with the time left of the whole."""

    def __init__(
        self, sink: Callable[[ProgressEvent], None], is_cancelled: Callable[[], bool]
    ) -> None:
        self._sink = sink
        self._is_cancelled = is_cancelled
        self._begun_s = time.monotonic()
        self._offset = 0.0

    def stage(self, name: str, span: _Span) -> Progress:
        def forward(event: ProgressEvent) -> None:
            overall = span.begin + (span.end - span.begin) * event.fraction
            elapsed_s = time.monotonic() - self._begun_s
            gained = overall - self._offset
            left_s = elapsed_s * (1.0 - overall) / gained if gained > 0.01 else None
            self._sink(
                ProgressEvent(name, overall, event.message, event.figures, left_s, event.phase)
            )

        return Progress(name, forward, self._is_cancelled)

    def skip_to(self, fraction: float) -> None:
        """Stages up to here were re-used: they tell nothing about the time left."""
        self._begun_s = time.monotonic()
        self._offset = fraction


def run_job(
    folder: JobFolder,
    job: JobFile,
    sink: Callable[[ProgressEvent], None],
    is_cancelled: Callable[[], bool],
) -> None:
    """Run a job to its end in ``folder``; finished stages are re-used.

    Raises
    ------
    WrapError
        Any typed failure of a stage; stages finished so far stay.
    """
    threads = job.settings.threads or default_threads()
    overall = _JobProgress(sink, is_cancelled)
    begun_s = time.time()
    reject_region_conflicts(folder.result, job)
    names = region_names(job.settings.regions, job.region_bodies)

    cameras = _run_cameras(folder, job, overall, threads)
    if cameras.reused:
        overall.skip_to(STAGE_SHARES["cameras"])
    trained = _run_training(folder, job, cameras, overall, threads)
    if trained.reused:
        overall.skip_to(STAGE_SHARES["cameras"] + STAGE_SHARES["train"])

    begin = STAGE_SHARES["cameras"] + STAGE_SHARES["train"]
    share = (1.0 - STAGE_SHARES["export"] - begin) / len(names)
    regions: list[tuple[str, Stage, Stage]] = []
    for index, (request, name) in enumerate(zip(job.settings.regions, names, strict=True)):
        start = begin + index * share
        cut = start + share * STAGE_SHARES["mesh"] / (
            STAGE_SHARES["mesh"] + STAGE_SHARES["texture"]
        )
        meshed = _run_meshing(
            folder, job, request, name, cameras, trained, overall.stage("mesh", _Span(start, cut)),
            threads,
        )  # fmt: skip
        textured = _run_texture(
            folder, job, name, cameras, trained, meshed,
            overall.stage("texture", _Span(cut, start + share)), threads,
        )  # fmt: skip
        regions.append((name, meshed, textured))

    progress = overall.stage("export", _Span(1.0 - STAGE_SHARES["export"], 1.0))
    from .stages.export_stage import export_results

    summary = {
        "command": job.command,
        "source": Path(job.source).name,
        "settings": to_json(job.settings),
        "machine": describe_machine(threads),
        "started_unix_s": round(begun_s, 1),
        "wall_seconds": round(time.time() - begun_s, 1),
        "peak_memory_bytes": peak_memory_bytes(),
    }
    export_results(folder, job, cameras, trained, regions, summary, progress)
    progress.update(1.0, "finished")


def _run_cameras(folder: JobFolder, job: JobFile, overall: _JobProgress, threads: int) -> Stage:
    from ..dataset.loading.load import load_scene
    from ..dataset.scene_file import save_scene
    from .stages.splat_scene import is_splat, make_splat_scene

    source = Path(job.source)
    key = stage_key(
        STAGE_VERSIONS["cameras"], job.source, source_fingerprint(source), job.settings.seed
    )
    if job.command == "mesh" and read_done(folder.stages / f"cameras-{key}") is None:
        earlier = _cameras_of_finished_training(folder, job)
        if earlier is not None:
            _logger.warning(
                "%s has changed since the training, or its files have new dates: the mesh is of "
                "the training as it is. To train anew, run wrap.", source,
            )  # fmt: skip
            return earlier

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        if is_splat(source):
            scene = make_splat_scene(source, stage_folder, progress, threads=threads)
        else:
            scene = load_scene(
                source, stage_folder, progress, seed=job.settings.seed, threads=threads
            )
        save_scene(scene, stage_folder)
        return {
            "views": len(scene.views),
            "points": len(scene.points),
            "warnings": [warning.to_json() for warning in scene.warnings],
            "facts": scene.facts,
        }

    span = _Span(0.0, STAGE_SHARES["cameras"])
    return run_stage(folder.stages, "cameras", key, overall.stage("cameras", span), work)


def _cameras_of_finished_training(folder: JobFolder, job: JobFile) -> Stage | None:
    """Return the newest finished cameras that the job's training was finished on."""
    from .stages.training_stage import training_keys

    found: list[tuple[float, int, Stage]] = []
    for path in sorted(folder.stages.glob("cameras-*")):
        done, key = read_done(path), path.name.removeprefix("cameras-")
        train_key, _ = training_keys(STAGE_VERSIONS["train"], key, job)
        trained = read_done(folder.stages / f"train-{train_key}")
        if done is not None and trained is not None:
            stage = Stage("cameras", key, path, done, True)
            found.append((trained["finished_unix_s"], len(found), stage))
    return max(found)[2] if found else None


def _run_training(
    folder: JobFolder, job: JobFile, cameras: Stage, overall: _JobProgress, threads: int
) -> Stage:
    from .stages.training_stage import run_training

    span = _Span(STAGE_SHARES["cameras"], STAGE_SHARES["cameras"] + STAGE_SHARES["train"])
    progress = overall.stage("train", span)
    version = STAGE_VERSIONS["train"]
    return run_training(folder, job, cameras, progress, version=version, threads=threads)


def _run_meshing(
    folder: JobFolder,
    job: JobFile,
    request: str,
    name: str,
    cameras: Stage,
    trained: Stage,
    progress: Progress,
    threads: int,
) -> Stage:
    meshing = job.meshing_of(request)
    body = job.region_bodies.get(request)
    key = mesh_key(job, request, name, trained.key)

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        import numpy as np

        from ..dataset.scene_file import load_saved_scene
        from ..field.depth_samples import sample_depth_maps
        from ..field.vector_field import VectorField
        from ..gaussians.gaussian_file import load_gaussians
        from ..mesh.mesh_file import save_mesh
        from ..meshing.checks.manifold_check import validate_manifold
        from ..meshing.checks.mesh_statistics import mesh_statistics
        from ..meshing.cleanup.clean_up import clean_up
        from ..meshing.cleanup.open_boundary import without_caps
        from ..regions.region import write_region
        from .stages.region_field import field_figures, region_field, requested_region
        from .stages.region_meshing import (
            mesh_by_pivots_in_stage,
            mesh_in_stage,
            remove_tiles,
            tiles_origin,
        )

        scene = load_saved_scene(cameras.folder)
        gaussians = load_gaussians(trained.folder / "gaussians.npz")
        arrays = gaussians.arrays()
        region, world_region = requested_region(request, body, scene, arrays)
        vacancy = region_field(
            scene, arrays, region, job.settings.training, meshing, threads=threads,
            device=str(gaussians.means.device),
        )  # fmt: skip
        depth_samples = sample_depth_maps(
            gaussians, scene.cameras, lambda points: region.contains(points, 0.0),
            progress.span(0.0, 0.15), threads=threads,
        )  # fmt: skip
        if meshing.method == "pivots":
            mesh, expected = mesh_by_pivots_in_stage(
                stage_folder, vacancy, arrays, scene.cameras, region, meshing,
                progress.span(0.15, 0.9), seed=job.settings.seed, threads=threads,
                depth_samples=depth_samples,
            )  # fmt: skip
        else:
            mesh, expected = mesh_in_stage(
                stage_folder, vacancy, VectorField(arrays, threads=threads), arrays, scene.cameras,
                region, meshing, progress.span(0.15, 0.9), seed=job.settings.seed, threads=threads,
                edge_length_scene=meshing.edge_length / scene.world_from_scene.scale,
                depth_samples=depth_samples,
                origin=tiles_origin(cameras.folder, trained.folder, job.settings),
            )  # fmt: skip
        mesh, dense = clean_up(mesh, region, meshing, vacancy, progress.span(0.9, 0.97))
        open_at = region if meshing.boundary == "open" else None
        if open_at is not None:
            mesh = without_caps(mesh, open_at, meshing.min_component_share)
            if dense is not None:
                dense = without_caps(dense, open_at, meshing.min_component_share)
        mesh.provenance.update(field_figures(vacancy))
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

    return run_stage(folder.stages, f"mesh-{name}", key, progress, work)


def _run_texture(
    folder: JobFolder,
    job: JobFile,
    name: str,
    cameras: Stage,
    trained: Stage,
    meshed: Stage,
    progress: Progress,
    threads: int,
) -> Stage:
    texture = job.settings.texture
    key = stage_key(STAGE_VERSIONS["texture"], meshed.key, to_json(texture))

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        from ..dataset.photo_source import PhotoSource
        from ..dataset.photos.photo_store import PhotoStore
        from ..dataset.scene_file import load_saved_scene
        from ..evaluation.views.photo_comparison import compare_with_photos
        from ..evaluation.views.preview import write_preview
        from ..files import read_json
        from ..limits import MAX_IMAGE_SIDE_PX
        from ..mesh.mesh_file import load_mesh
        from ..regions.region import parse_region
        from ..texture.detail.levels_of_detail import levels_of_detail
        from ..texture.files.textured_files import file_offset, write_textured
        from ..texture.texture_mesh import texture_mesh
        from .stages.region_meshing import free_bytes

        scene = load_saved_scene(cameras.folder)
        photos = PhotoStore(scene, MAX_IMAGE_SIDE_PX)
        mesh = load_mesh(meshed.folder / "mesh.npz")
        dense_path = meshed.folder / DENSE_MESH
        dense = load_mesh(dense_path) if dense_path.is_file() else None
        source: PhotoSource = photos
        if texture.source == "gaussians":
            from ..gaussians.gaussian_file import load_gaussians
            from ..texture.bake.gaussian_photos import GaussianPhotos

            trained_file = trained.folder / "gaussians.npz"
            source = GaussianPhotos(load_gaussians(trained_file), photos, threads=threads)
        coarse_from = 0.7 if texture.lods else 0.9
        textured = texture_mesh(
            mesh, scene, source, texture, stage_folder, progress.span(0.0, coarse_from),
            threads=threads, dense=dense, free_bytes=free_bytes(stage_folder, threads),
        )  # fmt: skip
        region_path = meshed.folder / "region.json"
        region = parse_region(read_json(region_path), region_path)
        levels = levels_of_detail(
            textured, dense, texture, stage_folder, progress.span(coarse_from, 0.9),
            threads=threads, region=region.transformed(scene.world_from_scene.inverse()),
        )  # fmt: skip
        formats = tuple(f for f in job.settings.export if f in RESULT_FORMATS)
        offset = file_offset(scene.world_from_scene.points(mesh.vertices))
        for number, level in enumerate([textured, *levels]):
            folder = stage_folder / "files" / (f"lod{number}" if number else "")
            write_textured(level, folder, formats, scene.world_from_scene, offset)
        if levels:
            textured.statistics["lods"] = [level.statistics for level in levels]
        progress.update(0.92, "comparing with photos")
        held_out = {figure["name"] for figure in trained.done["held_out"]}
        rendering = compare_with_photos(
            textured, scene, photos, held_out, stage_folder, progress.span(0.92, 0.97),
            from_gaussians=texture.source == "gaussians", threads=threads,
        )  # fmt: skip
        progress.update(0.97, "rendering the preview")
        write_preview(textured, scene, photos, stage_folder / "preview.png", threads=threads)
        return {"texture": textured.statistics, "mesh_rendering": rendering}

    formats = json.dumps(sorted(job.settings.export))
    return run_stage(folder.stages, f"texture-{name}", stage_key(key, formats), progress, work)
