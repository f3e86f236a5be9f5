# SPDX-License-Identifier: GPL-3.0-or-later
"""Training stage: estimate cost, continue a shorter training, retry when out of memory."""

from __future__ import annotations

import dataclasses
import json
import logging
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...array_file import is_whole
from ...devices import DeviceChoice, stage_device
from ...errors import DatasetError
from ...progress import COMPILING, Progress
from ...report_warning import ReportWarning
from ...settings import TrainingSettings, key_values, to_json
from ..store.continue_training import (
    checkpoints,
    lineage,
    link_checkpoints,
    nothing_to_continue,
    shorter_training,
)
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import Stage, read_done, record_interrupted_time, run_stage, stage_key
from .oom_retry import RETRIES_FILE, train_with_oom_retry

if TYPE_CHECKING:
    import numpy as np

    from ...dataset.scene import Scene
    from ...training.result import TrainingResult

_logger = logging.getLogger(__name__)

GAUSSIANS_NAME = "gaussians.npz"
"""In a training stage: the trained Gaussians, which all later stages read."""

REFINED = "poses_refined"
"""Entry of ``done.json``: whether refined camera poses lie beside the Gaussians."""


def start_fingerprint(path: str) -> list[Any]:
    """Return path, size and time of the start splat for the stage key; empty for none.

    Raises
    ------
    DatasetError
        The file does not exist, or is a pipe or a device.
    """
    if not path:
        return []
    hint = "Put the file back, or start the job without it."
    try:
        state = Path(path).stat()
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"The start splat {path} cannot be read: {getattr(error, 'strerror', error)}.", hint
        ) from None
    if not stat.S_ISREG(state.st_mode):
        raise DatasetError(f"The start splat {path} is not a regular file.", hint)
    return [path, state.st_size, state.st_mtime_ns]


def training_keys(version: int, cameras_key: str, job: JobFile) -> tuple[str, str]:
    """Return the stage's key, and the key without the extra iterations."""
    described = key_values(job.settings.training)
    start = start_fingerprint(job.settings.start_splat)
    parts = (version, cameras_key, job.settings.seed, *([start] if start else []))
    key = stage_key(*parts, described)
    described.pop("extra_iterations")
    return key, stage_key(*parts, described)


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
            done = _train(stage_folder, job, cameras, progress, threads, device)
        except BaseException:
            record_interrupted_time(folder.stages, "train", key, time.monotonic() - begun_s)
            raise
        return {**done, "lineage": lineage(base_key, extra)}

    def whole(stage_folder: Path) -> bool:
        from ...dataset.refined_scene import POSES_NAME

        done = read_done(stage_folder) or {}
        names = [GAUSSIANS_NAME, *([POSES_NAME] if done.get(REFINED) else [])]
        return all(is_whole(stage_folder / name) for name in names)

    return run_stage(folder.stages, "train", key, progress, work, whole=whole)


def _train(
    stage_folder: Path,
    job: JobFile,
    cameras: Stage,
    progress: Progress,
    threads: int,
    device: DeviceChoice,
) -> dict[str, Any]:
    from ...dataset.photos.photo_store import PhotoStore
    from ...dataset.refined_scene import load_refined_scene, save_poses
    from ...dataset.scene_file import load_saved_scene
    from ...dataset.view_split import held_out_views
    from ...devices.whole_views import with_renderer
    from ...evaluation.report.pictures import write_held_out
    from ...gaussians.gaussian_file import save_gaussians
    from ...training.checkpoint import remove_checkpoints
    from ...training.devices.chosen import chosen_backend
    from ...training.trainer import train
    from .splat_scene import start_splat_of

    scene = load_saved_scene(cameras.folder)
    device = _fitting(scene, job, device)
    estimated, warnings = _estimate(scene, job, stage_folder, progress, threads, device)

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
    result = trained.result
    save_gaussians(stage_folder / GAUSSIANS_NAME, result.gaussians)
    save_poses(stage_folder, result.poses)
    if result.poses is not None:
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
    done = {**result.to_json(), REFINED: result.poses is not None}
    earlier = [warning.to_json() for warning in (*warnings, *trained.warnings)]
    done["warnings"] = [*earlier, *done["warnings"]]
    return {
        **done,
        "device": result.device,
        "device_reason": device.reason,
        "pictures": pictures,
        "estimate": estimated,
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


def _fitting(scene: Scene, job: JobFile, device: DeviceChoice) -> DeviceChoice:
    """Return the job's device, or the processor where its memory does not suffice."""
    from ...training.cost.training_estimate import gpu_bytes, scene_facts

    if not device.is_cuda:
        return device
    training = job.settings.training
    needed = gpu_bytes(scene_facts(scene), training, training.max_gaussians)
    return stage_device(device, job.settings.device, needed, "Training")


def _estimate(
    scene: Scene,
    job: JobFile,
    stage_folder: Path,
    progress: Progress,
    threads: int,
    device: DeviceChoice,
) -> tuple[dict[str, Any], list[ReportWarning]]:
    """Estimate the training's cost; raise if the disk is too full.

    Compiles the renderer first if that was never done on this machine.
    """
    from ...training.cost.machine_speed import renderer_is_compiled, speeds
    from ...training.cost.training_estimate import (
        check_resources,
        estimate,
        scene_facts,
        this_machine,
    )
    from ...training.initialisation.splat_start import wrapping_settings
    from ...training.warm_up import compile_kernels
    from .splat_scene import start_splat_of

    training = job.settings.training
    if start_splat_of(job) is not None:
        training = wrapping_settings(training)
    if not device.is_cuda and not renderer_is_compiled():
        progress.enter(COMPILING, "compiling the renderer, about a minute, only this once")
        compile_kernels(training, stage_folder, progress, threads=threads)
    progress.update(0.0, "timing this machine")
    machine = this_machine(stage_folder, threads, *speeds(threads, device.device))
    done = [int(path.stem.rpartition("-")[2]) for path in checkpoints(stage_folder)]
    first = max(done, default=0)
    expected = estimate(scene_facts(scene), training, machine, first=first)
    warnings = check_resources(expected, machine)  # raises where the disk is too full
    _logger.info("estimate: %s", expected.sentence())
    for warning in warnings:
        _logger.warning("%s", warning.text)
    progress.update(0.0, f"training will take {expected.span()}")
    values = {**dataclasses.asdict(expected), "speed": machine.speed}
    return values, warnings
