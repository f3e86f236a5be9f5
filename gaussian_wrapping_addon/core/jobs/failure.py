# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job that failed tells: exit code, error and next step of any exception."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from pathlib import Path

from ..errors import (
    DISK_FULL_ERRNOS,
    EXIT_OTHER,
    EXIT_RESOURCES,
    WrapError,
    unwritable_error,
)
from ..processes.worker_requirements import package_error

FULL_DISK_HINT = "Make room on that disk, then resume: the last checkpoint is intact."
MEMORY_HINT = "Close other programs, or choose a smaller preset."
BUG_HINT = "Send the job folder's log.txt with a bug report."
_NO_THREAD = "can't start new thread"
"""What Python says where the system gives no memory, or no number, to another thread."""


@dataclass(frozen=True)
class Failure:
    """What ``status.json`` says of a failed job."""

    code: int
    error: str
    hint: str
    is_known: bool = True
    """Whether users can do something about it; else the log needs the traceback."""


def failure_of(error: Exception, root: Path) -> Failure:
    """Describe an exception that ended a job.

    Parameters
    ----------
    root : Path
        The job folder: where a full disk is, if the error does not name a file.
    """
    if isinstance(error, WrapError):
        cause = error.__cause__
        is_full = isinstance(cause, OSError) and cause.errno in DISK_FULL_ERRNOS
        return Failure(error.exit_code, error.message, FULL_DISK_HINT if is_full else error.hint)
    if isinstance(error, OSError) and error.errno in DISK_FULL_ERRNOS:
        full = unwritable_error(error.filename or root, error)
        return Failure(full.exit_code, full.message, FULL_DISK_HINT)
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return Failure(EXIT_RESOURCES, "Not enough memory.", MEMORY_HINT)
    if isinstance(error, ImportError | OSError) and (known := package_error(error)):
        return Failure(known.exit_code, known.message, known.hint)
    if isinstance(error, RuntimeError) and _NO_THREAD in str(error):
        return Failure(EXIT_RESOURCES, "The system starts no further thread.", MEMORY_HINT)
    return Failure(EXIT_OTHER, f"Unexpected {type(error).__name__}: {error}", BUG_HINT, False)
