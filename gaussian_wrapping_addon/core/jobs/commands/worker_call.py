# SPDX-License-Identifier: GPL-3.0-or-later
"""Run a command of the command line in the worker's Python and report lines or an error.

Writes one JSON object per line to stdout, which :mod:`.run_in_worker` reads.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable

from ...errors import (
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_OTHER,
    EXIT_RESOURCES,
    MissingExtraError,
    WrapError,
    known_error,
)
from ...processes.helper_process import emit
from ...processes.process_identity import Caller
from ...processes.worker_requirements import package_error
from ...report_warning import ReportWarning

PARENT_POLL_S = 1.0


def run_command(
    work: Callable[[], Iterable[str | ReportWarning]], memory_hint: str = "Close other programs.",
    leave: Callable[[], object] | None = None,
) -> int:  # fmt: skip
    """Emit the lines and warnings of ``work`` as they come, or its error; return the exit code.

    The process ends when its caller does.

    Parameters
    ----------
    leave : callable, optional
        Called in another thread before the process ends with its caller: takes away what ``work``
        has left elsewhere.
    """
    watched = (Caller(),) if leave is None else (Caller(), leave)
    threading.Thread(target=exit_with_caller, args=watched, daemon=True).start()
    try:
        for line in work():
            if isinstance(line, ReportWarning):
                emit(warning=line.text, code=line.code)
            else:
                emit(line=line)
    except MissingExtraError as error:
        emit(error=error.message, hint=error.hint, extras=error.extras)
        return error.exit_code
    except WrapError as error:
        emit(error=error.message, hint=error.hint)
        return error.exit_code
    except MemoryError:
        emit(error="Not enough memory.", hint=memory_hint)
        return EXIT_RESOURCES
    except ImportError as error:
        missing = package_error(error)
        if missing is None:
            raise
        emit(error=missing.message, hint=missing.hint)
        return missing.exit_code
    except OSError as error:
        known = known_error(error) or package_error(error)
        if known is not None:
            emit(error=known.message, hint=known.hint)
            return known.exit_code
        emit(error=f"{error}.", hint="Check the path and its permissions.")
        return EXIT_OTHER
    return EXIT_DONE


def exit_with_caller(caller: Caller, leave: Callable[[], object] | None = None) -> None:
    """End this process when its caller has ended: nothing reads the output any more."""
    while not caller.ended():
        time.sleep(PARENT_POLL_S)
    if leave is not None:
        leave()
    os._exit(EXIT_CANCELLED)
