# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training will cost here, before it begins: device, time, memory and disk."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...devices import DeviceChoice, stage_device
from ...progress import COMPILING, Progress, ReportWarning
from ...settings import TrainingSettings
from ..store.job_file import JobFile
from ..store.rollback import checkpoints

if TYPE_CHECKING:
    from ...scene.scene import Scene

_logger = logging.getLogger(__name__)


def fitting_device(
    scene: Scene, job: JobFile, device: DeviceChoice, gaussians: int | None = None
) -> DeviceChoice:
    """Return the job's device, or the processor where its memory does not suffice.

    ``gaussians``: largest number of them; by default that of the whole training.
    """
    from ...training.estimate import gpu_bytes, scene_facts

    if not device.is_cuda:
        return device
    training = job.settings.training
    needed = gpu_bytes(scene_facts(scene), training, gaussians or training.max_gaussians)
    return stage_device(device, job.settings.device, needed, "Training")


def compile_if_needed(
    settings: TrainingSettings, folder: Path, progress: Progress, threads: int, device: DeviceChoice
) -> None:
    """Compile the renderer if that was never done on this machine, and say so."""
    from ...training.estimate import renderer_is_compiled
    from ...training.warm_up import compile_kernels

    if device.is_cuda or renderer_is_compiled():
        return
    progress.enter(COMPILING, "compiling the renderer, about a minute, only this once")
    compile_kernels(settings, folder, progress, threads=threads)


def estimated_cost(
    scene: Scene, job: JobFile, stage_folder: Path, progress: Progress, threads: int,
    device: DeviceChoice,
) -> tuple[dict[str, Any], list[ReportWarning]]:  # fmt: skip
    """Estimate the training's cost, for ``done.json``; the renderer is compiled for it.

    Raises ResourceError: the disk is too full.
    """
    from ...training import estimate
    from ...training.splat_start import wrapping_settings
    from .cameras import start_splat_of

    training = job.settings.training
    if start_splat_of(job) is not None:
        training = wrapping_settings(training)
    compile_if_needed(job.settings.training, stage_folder, progress, threads, device)
    progress.update(0.0, "timing this machine")
    machine = estimate.this_machine(stage_folder, threads, *estimate.speeds(threads, device.device))
    done = [int(path.stem.rpartition("-")[2]) for path in checkpoints(stage_folder)]
    facts, first = estimate.scene_facts(scene), max(done, default=0)
    expected = estimate.estimate_training(facts, training, machine, first=first)
    warnings = estimate.check_resources(expected, machine)  # raises where the disk is too full
    _logger.info("estimate: %s", expected.sentence())
    for warning in warnings:
        _logger.warning("%s", warning.text)
    progress.update(0.0, f"training will take {expected.span()}")
    return {**dataclasses.asdict(expected), "speed": machine.speed}, warnings
