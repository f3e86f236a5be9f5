# SPDX-License-Identifier: GPL-3.0-or-later
"""``wrap``, ``queue``, ``more``, ``resume``, ``estimate``: jobs that train; and ``settings``."""

from __future__ import annotations

import logging
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import EXIT_DONE, DatasetError, UsageError, WrapError, known_error
from ..core.files import real_path
from ..core.jobs.store.job_folder import JobFolder
from ..core.settings import declared
from .job_commands import follow, require_bpy, run_in_worker, run_job
from .mesh_commands import follow_bake
from .options import (
    Commands,
    add_device,
    add_no_blend,
    add_option,
    add_options,
    add_out,
    add_training_options,
    declared_options,
    given_path,
    option_of,
    region_settings,
    training_settings,
)

if TYPE_CHECKING:
    from ..core.jobs.store.job_file import JobFile

_logger = logging.getLogger("gaussian_wrapping")

MOST_JOBS = 10_000
"""Of a queue."""


def add_wrap(commands: Commands) -> None:
    parser = commands.add_parser(
        "wrap", help="make a textured mesh of photos, with or without cameras, or of a video"
    )
    parser.add_argument("input", type=given_path)
    add_training_options(parser)
    add_out(parser)
    add_options(parser, declared_options("training", "method", "region"))
    add_no_blend(parser)
    parser.add_argument(
        "--plan-only", action="store_true", help="write the job and its parts, run nothing"
    )
    parser.set_defaults(run=_wrap)


def _wrap(options: Namespace) -> int:
    from ..core.jobs.client import JobClient, prepare_job, worker_python

    job = checked_job(options.input, options)
    if not options.plan_only:
        require_bpy(job, options)
        return follow(JobClient.start(options.out, job, python=worker_python()), job, options)
    from ..core.jobs.parts.graph import plan_if_missing

    folder = prepare_job(options.out, job)
    graph = plan_if_missing(folder)
    _logger.info("%d parts are planned; parts %s lists them", len(graph.parts), folder.root)
    return EXIT_DONE


def checked_job(photos: Path, options: Namespace) -> JobFile:
    """Return the job that wraps photos with the options given; warn of what they show.

    Raises DatasetError, UsageError, DeviceError: the photos, an option or the device cannot be
    used.
    """
    from ..core.jobs.client import worker_if_any
    from ..core.jobs.commands.device_check import require_device
    from ..core.jobs.store.job_file import make_job
    from ..core.loading.check import check_input

    settings = training_settings(options)
    # Presets of the program have no settings of textures; those of users have.
    job = make_job("wrap", photos, region_settings(settings, options, texture_stays=True))
    if job.settings.training.blocks > 1 and not job.settings.computers:
        raise UsageError(
            "--set blocks saves no time in one process.", "Give --computers as well, or omit it."
        )
    for path in ("certificates", "processes"):
        if getattr(options, path) is not None and not job.settings.computers:
            raise UsageError(
                f"{option_of(path)} has no effect on this computer alone.",
                "Give --computers as well, or omit it.",
            )
    require_device(job.settings.device)
    _reject_frames_of_photos(job)
    panoramas = job.settings.equirectangular
    for finding in check_input(photos, worker=worker_if_any(), panoramas=panoramas):
        if finding.severity == "error":
            raise DatasetError(finding.message, finding.hint)
        if finding.severity == "warning":
            _logger.warning("warning: %s %s", finding.message, finding.hint)
    return job


def _reject_frames_of_photos(job: JobFile) -> None:
    """Raise for options of videos where the input is none: they would do nothing."""
    from ..core.jobs.stages.cameras import frames_request

    for path in ("video_frames", "video_fps"):
        if getattr(job.settings, path) and frames_request(job) is None:
            raise UsageError(
                f"{option_of(path)} has no effect: {Path(job.source).name} is no video.",
                "Omit it, or give the video.",
            )


def add_continue_training(commands: Commands) -> None:
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
    from ..core.jobs.store.rollback import continue_training_job, finished_job

    folder = JobFolder(real_path(options.out))
    job = continue_training_job(folder, finished_job(folder), options.iterations)
    return run_job(_on_device(job, options), options)


def _on_device(job: JobFile, options: Namespace) -> JobFile:
    """Return a job that runs on the device of ``--device``, or on its own."""
    if options.device is None:
        return job
    return replace(job, settings=replace(job.settings, device=options.device).validated())


def add_resume(commands: Commands) -> None:
    parser = commands.add_parser("resume", help="resume a job that was stopped")
    parser.add_argument("out", type=given_path, metavar="DIR")
    entry = declared("training.max_gaussians")
    add_option(parser, entry, dest="max_gaussians", help="train anew with this maximum")
    add_device(parser, kept=True)
    add_no_blend(parser)
    parser.set_defaults(run=_resume)


def _resume(options: Namespace) -> int:
    from ..core.jobs.client import JobClient, worker_python
    from ..core.jobs.commands.device_check import require_device
    from ..core.jobs.store.job_file import read_job

    job = _on_device(read_job(JobFolder(real_path(options.out)).job_path), options)
    if options.max_gaussians is None:
        if job.bake is not None:
            return follow_bake(JobClient.resume(options.out, python=worker_python()), job)
        require_bpy(job, options)
        require_device(job.settings.device)
        client = JobClient.resume(options.out, python=worker_python(), device=options.device)
        return follow(client, job, options)
    # A training with another maximum starts anew: extra iterations do not apply.
    training = replace(
        job.settings.training, max_gaussians=options.max_gaussians, extra_iterations=0
    )
    settings = replace(job.settings, training=training).validated()
    return run_job(replace(job, command="wrap", settings=settings, bake=None), options)


def add_estimate(commands: Commands) -> None:
    parser = commands.add_parser("estimate", help="estimate time, memory and disk of a training")
    parser.add_argument("input", type=given_path)
    add_training_options(parser)
    add_options(parser, declared_options("training"))
    parser.set_defaults(run=_estimate)


def _estimate(options: Namespace) -> int:
    from ..core.jobs.commands.device_check import require_device
    from ..core.jobs.store.job_file import make_job

    # Masks of a region need the region, and hardly change what the training costs.
    settings = replace(training_settings(options), make_masks="off")
    job = make_job("wrap", options.input, settings)
    _reject_frames_of_photos(job)
    require_device(job.settings.device)
    return run_in_worker(job.to_json(), module="jobs.commands.estimate_command", what="estimate")


def add_settings(commands: Commands) -> None:
    parser = commands.add_parser("settings", help="list what --set NAME=VALUE can set")
    parser.add_argument("words", nargs="*", metavar="WORD", help="list those alone that have it")
    parser.set_defaults(run=_settings)


def _settings(options: Namespace) -> int:
    lines = []
    for entry in declared_options("training", "method", "region"):
        option = entry.option
        if option is None:
            continue
        if option.own:  # listed where it is asked for: --set does not take it
            owned = f"{option.word}: see the option {option.name}: {option.help or entry.help}"
            if options.words and _has(owned, options.words):
                lines.append(owned)
            continue
        default = entry.default if entry.default != "" else "empty"
        valid = f" ({entry.check.wanted})" if entry.check is not None else ""
        text = f"{option.word}={default}{valid}: {option.help or entry.help}"
        if _has(text, options.words):
            lines.append(text)
    if not lines:
        raise UsageError(
            f"No setting has {' '.join(options.words)} in its name or description.",
            "The command settings without words lists all that --set takes.",
        )
    for line in lines:
        _logger.info("%s", line)
    return EXIT_DONE


def _has(text: str, words: Sequence[str]) -> bool:
    return all(word.lower().replace("-", "_") in text.lower() for word in words)


def add_queue(commands: Commands) -> None:
    parser = commands.add_parser(
        "queue", help="wrap each folder of photos in a folder, and list the results"
    )
    parser.add_argument(
        "input", type=given_path, metavar="FOLDER", help="folder of folders of photos"
    )
    add_training_options(parser)
    add_out(parser)
    add_options(parser, declared_options("training", "method", "region"))
    parser.set_defaults(run=_queue)


def _queue(options: Namespace) -> int:
    from ..core.jobs.client import prepare_job

    root, out = real_path(options.input), real_path(options.out)
    if out == root or out.is_relative_to(root):
        raise UsageError(f"{options.out} lies inside {options.input}.", "Give a folder beside it.")
    if JobFolder(out).locked():
        raise UsageError(f"A queue is running in {out}.", "Wait for it, or end it first.")
    names, refused = [], 0
    for folder in _folders(root):
        try:
            job = checked_job(folder, options)
            # The queue spreads jobs, not their parts: those would wait for places that jobs hold.
            job = replace(job, settings=replace(job.settings, computers=""))
            if not _is_same(out / folder.name, job):
                prepare_job(out / folder.name, job)
            names.append(folder.name)
        except WrapError as error:
            refused += 1
            _logger.error("error: %s: %s", folder.name, error)
        except OSError as error:
            raise known_error(error, out) or error from None
    if not names:
        raise UsageError(f"No folder in {options.input} can be wrapped.", "See the errors above.")
    request = {
        "out": str(out), "jobs": names, "computers": options.computers or "",
        "processes": options.processes or declared("processes").default,
        "certificates": str(options.certificates or ""),
    }  # fmt: skip
    code = run_in_worker(request, module="jobs.queue_process", what="queue")
    return code or int(bool(refused))


def _folders(root: Path) -> list[Path]:
    """Return the folders of a folder, by name.

    Raises UsageError: there is no such folder, or it holds none, or too many.
    """
    if not root.is_dir():
        raise UsageError(f"{root} is not a folder.", "Give a folder of folders of photos.")
    found = sorted(p for p in root.iterdir() if p.is_dir() and not p.name.startswith("."))
    if not 0 < len(found) <= MOST_JOBS:
        raise UsageError(
            f"{root} holds {len(found)} folders, not from 1 to {MOST_JOBS}.",
            "Give a folder that holds one folder of photos for each wrap.",
        )
    return found


def _is_same(folder: Path, job: JobFile) -> bool:
    """Return whether a folder holds this job already, begun or finished, and run the same way."""
    from ..core.jobs.parts.graph import plan_hash
    from ..core.jobs.store.job_file import read_job

    try:
        known = read_job(JobFolder(folder).job_path)
        same = known.settings.computers == job.settings.computers
        return same and plan_hash(known) == plan_hash(job)
    except (WrapError, OSError):
        return False
