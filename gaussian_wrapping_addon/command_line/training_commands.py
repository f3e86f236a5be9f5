# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands ``wrap``, ``more``, ``resume`` and ``estimate``: jobs that train."""

from __future__ import annotations

import logging
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.settings import declared
from .bake_command import follow_bake
from .common import Commands, add_device, add_no_blend, add_out
from .follow import follow, require_bpy
from .options.meshing_options import add_method_options, add_region_options, region_settings
from .options.setting_options import add_option, option_of
from .options.training_options import add_training_options, training_settings

if TYPE_CHECKING:
    from ..core.jobs.store.job_file import JobFile

_logger = logging.getLogger("gaussian_wrapping")


def add_wrap(commands: Commands) -> None:
    """Add ``wrap``."""
    parser = commands.add_parser(
        "wrap", help="make a textured mesh of photos, with or without cameras, or of a video"
    )
    parser.add_argument("input", type=Path)
    add_training_options(parser)
    add_out(parser)
    add_method_options(parser)
    add_region_options(parser)
    add_no_blend(parser)
    parser.set_defaults(run=_wrap)


def _wrap(options: Namespace) -> int:
    from ..core.dataset.loading.check import check_input
    from ..core.errors import DatasetError
    from ..core.jobs.client import JobClient, worker_if_any, worker_python
    from ..core.jobs.commands.device_check import require_device
    from ..core.jobs.store.job_file import make_job

    settings = training_settings(options)
    job = make_job("wrap", options.input, region_settings(settings, options))
    require_bpy(job, options)
    require_device(job.settings.device)
    _reject_frames_of_photos(job)
    for finding in check_input(options.input, worker=worker_if_any()):
        if finding.severity == "error":
            raise DatasetError(finding.message, finding.hint)
        if finding.severity == "warning":
            _logger.warning("warning: %s %s", finding.message, finding.hint)
    return follow(JobClient.start(options.out, job, python=worker_python()), job, options)


def _reject_frames_of_photos(job: JobFile) -> None:
    """Raise for options of videos where the input is none: they would do nothing."""
    from ..core.errors import UsageError
    from ..core.jobs.video.frames_stage import frames_request

    for path in ("video_frames", "video_fps"):
        if getattr(job.settings, path) and frames_request(job) is None:
            raise UsageError(
                f"{option_of(path)} has no effect: {Path(job.source).name} is no video.",
                "Omit it, or give the video.",
            )


def add_continue_training(commands: Commands) -> None:
    """Add ``more``."""
    parser = commands.add_parser(
        "more", help="continue the training of a finished job, then mesh it again"
    )
    add_out(parser)
    entry = declared("training.extra_iterations")
    add_option(parser, entry, dest="iterations", required=True)
    add_device(parser, kept=True)
    add_no_blend(parser)
    parser.set_defaults(run=_continue_training)


def _continue_training(options: Namespace) -> int:
    from ..core.files import real_path
    from ..core.jobs.client import JobClient, worker_python
    from ..core.jobs.commands.device_check import require_device
    from ..core.jobs.store.continue_training import continue_training_job
    from ..core.jobs.store.job_folder import JobFolder
    from ..core.jobs.store.rollback import finished_job

    folder = JobFolder(real_path(options.out))
    job = continue_training_job(folder, finished_job(folder), options.iterations)
    if options.device is not None:
        job = replace(job, settings=replace(job.settings, device=options.device).validated())
    require_bpy(job, options)
    require_device(job.settings.device)
    return follow(JobClient.start(options.out, job, python=worker_python()), job, options)


def add_resume(commands: Commands) -> None:
    """Add ``resume``."""
    parser = commands.add_parser("resume", help="resume a job that was stopped")
    parser.add_argument("out", type=Path, metavar="DIR")
    entry = declared("training.max_gaussians")
    add_option(parser, entry, dest="max_gaussians", help="train anew with this maximum")
    add_device(parser, kept=True)
    add_no_blend(parser)
    parser.set_defaults(run=_resume)


def _resume(options: Namespace) -> int:
    from ..core.files import real_path
    from ..core.jobs.client import JobClient, worker_python
    from ..core.jobs.commands.device_check import require_device
    from ..core.jobs.store.job_file import read_job
    from ..core.jobs.store.job_folder import JobFolder

    job = read_job(JobFolder(real_path(options.out)).job_path)
    if options.device is not None:
        job = replace(job, settings=replace(job.settings, device=options.device).validated())
    if job.bake is not None and options.max_gaussians is None:
        return follow_bake(JobClient.resume(options.out, python=worker_python()), job)
    require_bpy(job, options)
    require_device(job.settings.device)
    if options.max_gaussians is None:
        client = JobClient.resume(options.out, python=worker_python(), device=options.device)
        return follow(client, job, options)
    # A training with another maximum starts anew: extra iterations do not apply.
    training = replace(
        job.settings.training, max_gaussians=options.max_gaussians, extra_iterations=0
    )
    settings = replace(job.settings, training=training).validated()
    job = replace(job, command="wrap", settings=settings, bake=None)
    return follow(JobClient.start(options.out, job, python=worker_python()), job, options)


def add_estimate(commands: Commands) -> None:
    """Add ``estimate``."""
    parser = commands.add_parser("estimate", help="estimate time, memory and disk of a training")
    parser.add_argument("input", type=Path)
    add_training_options(parser)
    parser.set_defaults(run=_estimate)


def _estimate(options: Namespace) -> int:
    from ..core.jobs.client import worker_python
    from ..core.jobs.commands.device_check import require_device
    from ..core.jobs.commands.run_in_worker import run_in_worker
    from ..core.jobs.store.job_file import make_job

    # Masks of a region need the region, and hardly change what the training costs.
    settings = replace(training_settings(options), make_masks="off")
    job = make_job("wrap", options.input, settings)
    _reject_frames_of_photos(job)
    require_device(job.settings.device)
    return run_in_worker(
        job.to_json(),
        python=worker_python(),
        module="jobs.commands.estimate_command",
        what="estimate",
    )
