# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands ``status``, ``cancel``, ``parts`` and ``run-part``, and the progress of any job."""

from __future__ import annotations

import importlib.util
import logging
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core import limits
from ..core.errors import EXIT_CANCELLED, EXIT_DONE, EXIT_OTHER, ParseError, UsageError, WorkerError
from ..core.files import read_json, real_path
from ..core.jobs.store.job_folder import NAME, JobFolder, back_up_stale_blend, result_state
from ..core.names import BLENDER_FORMATS
from ..core.settings import JobSettings
from .options import Commands, add_device, add_threads, given_path

if TYPE_CHECKING:
    from ..core.jobs.client import JobClient
    from ..core.jobs.store.job_file import JobFile
    from ..core.jobs.store.job_folder import JobStatus

_logger = logging.getLogger("gaussian_wrapping")

POLL_S = 0.2
LINE_EVERY_S = 5.0
CANCEL_WAIT_S = 12.0


def has_bpy() -> bool:
    """Tell whether this Python can write Blender files."""
    return importlib.util.find_spec("bpy") is not None


def require_bpy(job: JobFile, options: Namespace) -> None:
    """Raise before the job starts if its Blender files could not be written without bpy."""
    wants = not options.no_blend or bool(set(job.settings.export) & set(BLENDER_FORMATS))
    if wants and not has_bpy():
        raise UsageError(
            "Writing scene.blend or USD needs bpy, which this Python does not have.",
            "Add --no-blend (and leave usd out), run it in Blender, or pip install bpy.",
        )


def run_in_worker(request: dict[str, Any], *, module: str, what: str, grace_s: float = 2.0) -> int:
    """Run a command in the Python of the worker that is set up, as that of ``core`` does."""
    from ..core.jobs.client import worker_python
    from ..core.jobs.commands import run_in_worker as commands

    python = worker_python()
    return commands.run_in_worker(request, python=python, module=module, what=what, grace_s=grace_s)


def run_job(job: JobFile, options: Namespace) -> int:
    """Start a job in the folder of ``--out`` and follow it to its end; return the exit code."""
    from ..core.jobs.client import JobClient, worker_python
    from ..core.jobs.commands.device_check import require_device

    require_bpy(job, options)
    require_device(job.settings.device)
    return follow(JobClient.start(options.out, job, python=worker_python()), job, options)


def follow(client: JobClient, job: JobFile, options: Namespace) -> int:
    """Show progress until the worker ends; then write the Blender files. Return the exit code."""
    before = result_state(client.folder.result)  # the worker replaces it at its end
    code = watch(client)
    if code != EXIT_DONE:
        return code
    return _finish(client.folder.result, before, job, options) or EXIT_DONE


def watch(client: JobClient) -> int:
    """Show progress until the worker ends; return the exit code."""
    before = result_state(client.folder.result)
    shown_s, shown, interrupted_s = 0.0, ("", ""), 0.0
    while True:
        try:
            status = client.poll()
            now_s = time.monotonic()
            news = (status.stage, status.message)
            due = status.stage != shown[0] or now_s - shown_s > LINE_EVERY_S
            failed = status.state in ("FAILED", "LOST")
            # Not after a failure: the status of a rolled-back job shows 100 %.
            if status.stage and due and news != shown and not failed:
                shown_s, shown = now_s, news
                _logger.info("%s", progress_line(status))
            if not status.active:
                break
            if interrupted_s and now_s - interrupted_s > CANCEL_WAIT_S:
                client.kill()
                return EXIT_CANCELLED
            time.sleep(POLL_S)
        except KeyboardInterrupt:
            _logger.info("cancelling; the job can be resumed")
            client.cancel()
            interrupted_s = time.monotonic()
    if status.state == "CANCELLED":
        _logger.info("cancelled; continue with: resume %s", client.folder.root)
        return EXIT_CANCELLED
    if status.state != "DONE":
        _logger.error("error: %s %s", status.error, status.hint)
        if client.folder.read_status().state == "DONE":
            same = result_state(client.folder.result) == before
            _logger.info(
                "the job and its result are unchanged: %s" if same
                else "the job is unchanged, but its result is not; mesh it again: %s",
                client.folder.root,
            )  # fmt: skip
        return status.exit_code or EXIT_OTHER
    return EXIT_DONE


def _finish(result: Path, before: dict[str, bytes], job: JobFile, options: Namespace) -> int:
    """Write the Blender files; a ``scene.blend`` of the result ``before`` is renamed."""
    if options.no_blend:
        back_up_stale_blend(result, before)
    else:
        from ..ops.scene_objects import write_blend

        try:
            write_blend(result, result / NAME)
        except BaseException:
            back_up_stale_blend(result, before)
            raise
    if "usd" in job.settings.export:
        from ..ops.scene_objects import export_usd

        export_usd(result)
    from ..core.evaluation.report.report import headline

    _logger.info("results: %s", result)
    for line in headline(read_json(result / "report.json")):
        _logger.info("  %s", line)
    return 0


def progress_line(status: JobStatus) -> str:
    """Return how far a job is, in one line."""
    left = "" if status.seconds_left is None else f" · {_span(status.seconds_left)} left"
    return f"[{100 * status.fraction:5.1f} %] {status.stage:<7} {status.message}{left}"


def _span(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


STARTS_WITHIN_S = 30.0
"""A worker that was started longer ago and holds no lock has not come up."""
AFTER_KILL_S = 3.0
LEFT = "left"
"""Shown for a part that was not begun."""


def add_status(commands: Commands) -> None:
    parser = commands.add_parser("status", help="what a job is doing, or how it ended")
    _add_folder(parser)
    parser.set_defaults(run=_status)


def add_cancel(commands: Commands) -> None:
    parser = commands.add_parser("cancel", help="stop a running job, which can be resumed")
    _add_folder(parser)
    parser.set_defaults(run=_cancel)


def _add_folder(parser: ArgumentParser) -> None:
    parser.add_argument("out", type=given_path, metavar="DIR", help="job folder of that job")


def _status(options: Namespace) -> int:
    from ..core.jobs.client import JobClient

    client = JobClient.attach(options.out)
    status = client.poll()
    running = status.active and status.pid
    _logger.info("%s%s", status.state.lower(), f" (process {status.pid})" if running else "")
    if status.stage and status.state != "DONE":
        _logger.info("%s", progress_line(status))
    if status.error:
        _logger.info("error: %s %s", status.error, status.hint)
    if status.state == "DONE":
        _logger.info("results: %s", client.folder.result)
    elif not status.active:
        _logger.info("continue with: resume %s", client.folder.root)
    return EXIT_DONE


def _cancel(options: Namespace) -> int:
    from ..core.jobs.client import JobClient

    client = JobClient.attach(options.out)
    if not _may_run(client):
        _logger.info("no job is running in %s", client.folder.root)
        return EXIT_DONE
    client.cancel()
    if not _ends_within(client, limits.CANCEL_GRACE_S):
        client.kill()
        if not _ends_within(client, AFTER_KILL_S):
            raise WorkerError(
                f"The job in {client.folder.root} does not stop.",
                f"End process {client.folder.read_status().pid} with the tools of the system.",
            )
    state = client.folder.read_status().state
    if state == "DONE":
        _logger.info("finished before it could be cancelled: %s", client.folder.result)
    else:
        _logger.info("cancelled; continue with: resume %s", client.folder.root)
    return EXIT_DONE


def _may_run(client: JobClient) -> bool:
    """Return whether a worker holds the folder, or is coming up and will."""
    status = client.folder.read_status()
    starts = status.state == "NEW" and time.time() - status.heartbeat_s < STARTS_WITHIN_S
    return starts or client.folder.locked() or status.state in ("RUNNING", "CANCELLING")


def _ends_within(client: JobClient, seconds: float) -> bool:
    end_s = time.monotonic() + seconds
    while _may_run(client):
        if time.monotonic() > end_s:
            return False
        time.sleep(POLL_S)
    return True


def add_parts(commands: Commands) -> None:
    parser = commands.add_parser("parts", help="the parts of a job, and how far each is")
    _add_folder(parser)
    parser.set_defaults(run=_parts)


def _parts(options: Namespace) -> int:
    from ..core.jobs.parts.graph import PARTS_NAME, plan_if_missing, read_state

    root = real_path(options.out)
    folder = JobFolder(root)
    try:
        graph = plan_if_missing(folder)
    except ParseError as damaged:
        _logger.warning("%s", damaged.message)
        (root / PARTS_NAME).unlink()
        graph = plan_if_missing(folder)
    for part in graph.parts:
        state = read_state(root, part.name)
        if state is None or state.plan != graph.plan:
            _logger.info("%-28s %s", part.name, LEFT)
            continue
        told = f"{state.seconds:.0f} s on {state.host}"
        if state.state == "RUNNING":
            told = f"{100 * state.fraction:.0f} % {state.message}, {told}"
        if state.error:
            told = f"{told}: {state.error} {state.hint}".rstrip()
        _logger.info("%-28s %-8s %s", part.name, state.state.lower(), told)
    return EXIT_DONE


def add_run_part(commands: Commands) -> None:
    parser = commands.add_parser(
        "run-part", help="run one part of a planned job here, as a farm does"
    )
    _add_folder(parser)
    parser.add_argument("part", metavar="PART", help="its name, as parts DIR lists it")
    add_threads(parser)
    add_device(parser, kept=True)
    parser.set_defaults(run=_run_part)


def _run_part(options: Namespace) -> int:
    from ..core.jobs.commands.device_check import require_device

    JobSettings(threads=options.threads, device=options.device or "auto").validated()
    if options.device is not None:
        require_device(options.device)
    request = {
        "out": str(real_path(options.out)), "part": options.part, "threads": options.threads,
        "device": options.device or "", "attempt": 1, "driven": False,
    }  # fmt: skip
    return run_in_worker(request, module="jobs.part_process", what="part")
