# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands ``status`` and ``cancel``: look at a job, or stop it, from another terminal."""

from __future__ import annotations

import logging
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from .common import Commands
from .follow import POLL_S, progress_line

if TYPE_CHECKING:
    from ..core.jobs.client import JobClient

_logger = logging.getLogger("gaussian_wrapping")

STARTS_WITHIN_S = 30.0
"""A worker that was started longer ago and holds no lock has not come up."""
AFTER_KILL_S = 3.0


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
