# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a submitted job is, as its Manager says, with the last lines of failed tasks."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from ...errors import FarmError, unwritable_error
from ...jobs.store.job_folder import JobFolder
from ...regular_files import touch_regular
from .job_record import JobRecord
from .manager import Manager

FAILED_STATES = ("failed", "soft-failed")
"""Of a task; a soft-failed one is tried again by other workers."""
MAX_FAILED = 8
"""Failed tasks whose log is asked for."""


@dataclass(frozen=True)
class FailedTask:
    """A task that failed."""

    name: str
    status: str
    worker: str
    lines: tuple[str, ...]
    """Last lines of its log."""


@dataclass(frozen=True)
class FarmState:
    """What a Manager says of a job."""

    record: JobRecord
    status: str
    """Such as ``"queued"``, ``"active"``, ``"completed"``, ``"failed"``, ``"canceled"``."""
    counts: tuple[tuple[str, int], ...]
    """Number of tasks in each state, most first."""
    failed: tuple[FailedTask, ...]
    """At most :data:`MAX_FAILED`."""


def read_state(record: JobRecord) -> FarmState:
    """Ask a Manager how far a job is.

    Raises
    ------
    FarmError
        It does not answer, or does not know the job.
    """
    manager = Manager(record.address)
    status = manager.job_status(record.job)
    tasks = manager.tasks(record.job)
    counts = Counter(task.status for task in tasks).most_common()
    failed = [task for task in tasks if task.status in FAILED_STATES][:MAX_FAILED]
    shown = tuple(
        FailedTask(t.name, t.status, manager.worker_of(t.id), manager.last_lines(t.id))
        for t in failed
    )
    return FarmState(record, status, tuple(counts), shown)


def cancel(root: Path, record: JobRecord) -> None:
    """Cancel a job: its Manager ends its tasks, and its parts see the request in the folder.

    Raises
    ------
    FarmError
        The Manager does not answer; the request in the folder stays, and parts that run stop.
    """
    target = JobFolder(root)
    try:
        touch_regular(target.cancel_path)
    except OSError as error:
        raise unwritable_error(target.cancel_path, error) from None
    try:
        Manager(record.address).cancel(record.job)
    except FarmError as error:
        raise FarmError(
            f"The parts that run will stop, but the Manager was not told: {error.message}",
            error.hint,
        ) from None


def retry(root: Path, record: JobRecord) -> None:
    """Let the tasks of a job run again that failed or were cancelled.

    Raises
    ------
    FarmError
        The Manager does not answer, or refuses.
    """
    target = JobFolder(root)
    try:
        target.cancel_path.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable_error(target.cancel_path, error) from None
    Manager(record.address).requeue(record.job)
