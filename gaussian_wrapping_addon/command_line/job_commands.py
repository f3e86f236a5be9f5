# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands on a job from another terminal: ``status``, ``cancel``, ``parts``, ``run-part``."""

from __future__ import annotations

import logging
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from .common import Commands, add_device, add_threads
from .follow import POLL_S, progress_line

if TYPE_CHECKING:
    from ..core.jobs.client import JobClient

_logger = logging.getLogger("gaussian_wrapping")

STARTS_WITHIN_S = 30.0
"""A worker that was started longer ago and holds no lock has not come up."""
AFTER_KILL_S = 3.0
LEFT = "left"
"""Shown for a part that was not begun."""


def add_status(commands: Commands) -> None:
    """Add ``status``."""
    parser = commands.add_parser("status", help="what a job is doing, or how it ended")
    _add_folder(parser)
    parser.set_defaults(run=_status)


def add_cancel(commands: Commands) -> None:
    """Add ``cancel``."""
    parser = commands.add_parser("cancel", help="stop a running job, which can be resumed")
    _add_folder(parser)
    parser.set_defaults(run=_cancel)


def _add_folder(parser: ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="DIR", help="job folder of that job")


def _status(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE
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
    from ..core import limits
    from ..core.errors import EXIT_DONE, WorkerError
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
    """Add ``parts``."""
    parser = commands.add_parser("parts", help="the parts of a job, and how far each is")
    parser.add_argument("out", type=Path, metavar="DIR", help="job folder of that job")
    parser.set_defaults(run=_parts)


def _parts(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE, ParseError
    from ..core.files import real_path
    from ..core.jobs.parts.graph import PARTS_NAME, plan_if_missing, read_state
    from ..core.jobs.store.job_folder import JobFolder

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
    """Add ``run-part``."""
    parser = commands.add_parser(
        "run-part", help="run one part of a planned job here, as a farm does"
    )
    parser.add_argument("out", type=Path, metavar="DIR", help="job folder of that job")
    parser.add_argument("part", metavar="PART", help="its name, as parts DIR lists it")
    add_threads(parser)
    add_device(parser, kept=True)
    parser.set_defaults(run=_run_part)


def _run_part(options: Namespace) -> int:
    from ..core.files import real_path
    from ..core.jobs.client import worker_python
    from ..core.jobs.commands.device_check import require_device
    from ..core.jobs.commands.run_in_worker import run_in_worker
    from ..core.settings import JobSettings

    JobSettings(threads=options.threads, device=options.device or "auto").validated()
    if options.device is not None:
        require_device(options.device)
    request = {
        "out": str(real_path(options.out)), "part": options.part, "threads": options.threads,
        "device": options.device or "", "attempt": 1, "driven": False,
    }  # fmt: skip
    return run_in_worker(request, python=worker_python(), module="jobs.part_process", what="part")
