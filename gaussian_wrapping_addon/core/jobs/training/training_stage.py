# SPDX-License-Identifier: GPL-3.0-or-later
"""Training stage: continue a shorter training, retry when out of memory, join blocks."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...array_file import is_whole
from ...devices import DeviceChoice
from ...progress import Progress
from ...settings import TrainingSettings, to_json
from ..store.continue_training import (
    checkpoints,
    lineage,
    link_checkpoints,
    nothing_to_continue,
    shorter_training,
)
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import Stage, read_done, record_interrupted_time, run_stage
from ..store.training_keys import blocks_key, training_keys
from .block_stages import GAUSSIANS_NAME, BlockStages
from .oom_retry import RETRIES_FILE, Trained, train_with_oom_retry
from .training_cost import compile_if_needed, estimated_cost, fitting_device

if TYPE_CHECKING:
    import numpy as np

    from ...dataset.scene import Scene
    from ...training.result import TrainingResult

_logger = logging.getLogger(__name__)

REFINED = "poses_refined"
"""Entry of ``done.json``: whether refined camera poses lie beside the Gaussians."""


def run_training(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    progress: Progress,
    *,
    version: int,
    threads: int,
    device: DeviceChoice,
) -> Stage:
    """Train, or re-use a finished training.

    Parameters
    ----------
    device : DeviceChoice
        The job's. A training that was begun elsewhere continues here: no key depends on it.

    Raises
    ------
    UsageError
        The job continues a training, and there is no training to continue.
    ResourceError
        The disk is too full, or memory does not suffice even with reduced settings.
    """
    key, base_key = training_keys(version, cameras.key, job)
    extra = job.settings.training.extra_iterations

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        if extra and not checkpoints(stage_folder):
            shorter = shorter_training(folder.stages, base_key, extra)
            if shorter is not None:
                link_checkpoints(shorter, stage_folder, (RETRIES_FILE,))
            elif job.command == "more":
                raise nothing_to_continue(folder)
        begun_s = time.monotonic()
        try:
            if job.settings.training.blocks > 1:
                blocks = _blocks(folder, job, cameras, version, threads, device)
                done = _join(stage_folder, blocks, progress, device)
            else:
                done = _train(stage_folder, job, cameras, progress, threads, device)
        except BaseException:
            record_interrupted_time(folder.stages, "train", key, time.monotonic() - begun_s)
            raise
        return {**done, "lineage": lineage(base_key, extra)}

    trained = run_stage(folder.stages, "train", key, progress, work, whole=_is_whole)
    if job.settings.training.blocks == 1:
        return trained
    before = _blocks(folder, job, cameras, version, threads, device).finished(reused=trained.reused)
    return replace(trained, before=tuple(before))


def run_coarse(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    progress: Progress,
    *,
    version: int,
    threads: int,
    device: DeviceChoice,
) -> Stage:
    """Train coarsely and divide the scene into blocks, or re-use that or the finished training.

    Raises
    ------
    UsageError
        The scene cannot be divided into so many blocks.
    ResourceError
        The disk is too full, or memory does not suffice.
    """
    from ...dataset.scene_file import load_saved_scene
    from ...training.cost.blocks_estimate import coarse_gaussians

    trained = _finished_training(folder, job, cameras, version)
    if trained is not None:
        return trained
    scene = load_saved_scene(cameras.folder)
    device = fitting_device(scene, job, device, coarse_gaussians(job.settings.training))
    blocks = _blocks(folder, job, cameras, version, threads, device)
    blocks.root.mkdir(parents=True, exist_ok=True)
    estimated, warnings = estimated_cost(scene, job, blocks.root, progress, threads, device)
    return blocks.coarse(
        progress, inside=_inside_regions(job, scene), estimated=estimated, warnings=warnings
    )


def run_block(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    index: int,
    progress: Progress,
    *,
    version: int,
    threads: int,
    device: DeviceChoice,
) -> Stage:
    """Train a block, or re-use it or the finished training.

    Raises
    ------
    WorkerError
        The coarse training is not finished.
    ResourceError
        Memory does not suffice.
    """
    from ...dataset.scene_file import load_saved_scene
    from ...training.cost.blocks_estimate import gaussians_of_block

    trained = _finished_training(folder, job, cameras, version)
    if trained is not None:
        return trained
    scene = load_saved_scene(cameras.folder)
    device = fitting_device(scene, job, device, gaussians_of_block(job.settings.training))
    blocks = _blocks(folder, job, cameras, version, threads, device)
    compile_if_needed(job, blocks.root, progress, threads, device)
    return blocks.block(index, progress, inside=_inside_regions(job, scene))


def _finished_training(
    folder: JobFolder, job: JobFile, cameras: Stage, version: int
) -> Stage | None:
    """Return the training that blocks are for, if it is finished: they may be gone then."""
    key, _ = training_keys(version, cameras.key, job)
    path = folder.stages / f"train-{key}"
    done = read_done(path)
    if done is None or not _is_whole(path):
        return None
    return Stage("train", key, path, done, True)


def _is_whole(stage_folder: Path) -> bool:
    from ...dataset.refined_scene import POSES_NAME

    done = read_done(stage_folder) or {}
    names = [GAUSSIANS_NAME, *([POSES_NAME] if done.get(REFINED) else [])]
    return all(is_whole(stage_folder / name) for name in names)


def _blocks(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    version: int,
    threads: int,
    device: DeviceChoice,
) -> BlockStages:
    root = folder.stages / f"blocks-{blocks_key(version, cameras.key, job)}"
    return BlockStages(root, job, cameras, threads, device)


def _train(
    stage_folder: Path,
    job: JobFile,
    cameras: Stage,
    progress: Progress,
    threads: int,
    device: DeviceChoice,
) -> dict[str, Any]:
    """Train in one piece; return the content of ``done.json``."""
    from ...dataset.photos.photo_store import PhotoStore
    from ...dataset.scene_file import load_saved_scene
    from ...training.checkpoint import remove_checkpoints
    from ...training.devices.chosen import chosen_backend
    from ...training.trainer import train
    from ..stages.splat_scene import start_splat_of

    scene = load_saved_scene(cameras.folder)
    device = fitting_device(scene, job, device)
    estimated, warnings = estimated_cost(scene, job, stage_folder, progress, threads, device)
    inside = _inside_regions(job, scene)
    _logger.info("training on %s", device.device)

    def attempt(settings: TrainingSettings) -> TrainingResult:
        photos = PhotoStore(scene, settings.max_image_px)
        return train(
            scene, photos, settings, stage_folder, progress,
            seed=job.settings.seed, threads=threads, start_splat=start_splat_of(job), inside=inside,
            backend=chosen_backend(
                device.device, threads, or_processor=job.settings.device == "auto"
            ),
        )  # fmt: skip

    trained = train_with_oom_retry(
        attempt, job.settings.training, stage_folder, lambda: remove_checkpoints(stage_folder)
    )
    done = _written(stage_folder, cameras, trained, threads, device)
    earlier = [warning.to_json() for warning in (*warnings, *trained.warnings)]
    return {**done, "warnings": [*earlier, *done["warnings"]], "estimate": estimated}


def _join(
    stage_folder: Path, blocks: BlockStages, progress: Progress, device: DeviceChoice
) -> dict[str, Any]:
    """Join the blocks of a training; return the content of ``done.json``."""
    from ...dataset.scene_file import load_saved_scene

    device = fitting_device(load_saved_scene(blocks.cameras.folder), blocks.job, device)
    blocks = replace(blocks, device=device)
    compile_if_needed(blocks.job, stage_folder, progress, blocks.threads, device)
    trained = Trained(blocks.join(stage_folder, progress), blocks.job.settings.training, ())
    done = _written(stage_folder, blocks.cameras, trained, blocks.threads, device)
    return {**done, **blocks.figures(trained.result.seconds)}


def _written(
    stage_folder: Path,
    cameras: Stage,
    trained: Trained[TrainingResult],
    threads: int,
    device: DeviceChoice,
) -> dict[str, Any]:
    """Write Gaussians, poses and pictures of held-out photos; return the figures."""
    from ...dataset.photos.photo_store import PhotoStore
    from ...dataset.refined_scene import load_refined_scene, save_poses
    from ...dataset.view_split import held_out_views
    from ...devices.whole_views import with_renderer
    from ...evaluation.report.pictures import write_held_out
    from ...gaussians.gaussian_file import save_gaussians

    result = trained.result
    save_gaussians(stage_folder / GAUSSIANS_NAME, result.gaussians)
    save_poses(stage_folder, result.poses)
    scene = load_refined_scene(cameras.folder, stage_folder)
    measured = {figure.name: figure.psnr for figure in result.held_out}
    shown = [
        (index, scene.views[index].camera.name, measured[scene.views[index].camera.name])
        for index in held_out_views(scene, trained.settings.holdout_every)
        if scene.views[index].camera.name in measured
    ]
    photos = PhotoStore(scene, trained.settings.max_image_px)
    pictures = with_renderer(
        result.device,
        "Pictures of held-out photos",
        lambda renderer: write_held_out(
            result.gaussians, photos, shown, stage_folder, threads=threads, renderer=renderer
        ),
    )
    return {
        **result.to_json(),
        REFINED: result.poses is not None,
        "device": result.device,
        "device_reason": device.reason,
        "pictures": pictures,
        "settings": to_json(trained.settings),
    }


def _inside_regions(job: JobFile, scene: Scene) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the test whether points lie in the job's weighted regions, scene frame, if any."""
    from ...regions.region import parse_region
    from ...regions.scene_region import region_in_scene

    focus = job.settings.training.focus
    if not focus:
        return None
    regions = [
        region_in_scene(parse_region(body, Path("job.json")), scene.world_from_scene)
        for body in json.loads(focus)
    ]

    def inside(points: np.ndarray) -> np.ndarray:
        found = regions[0].contains(points, 0.0)
        for region in regions[1:]:
            found |= region.contains(points, 0.0)
        return found

    return inside
