# SPDX-License-Identifier: GPL-3.0-or-later
"""A question of the command line, answered by the worker's Python: lines, or an error.

Speaks one JSON object a line on stdout, as :mod:`.evaluate_command` reads them.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable

from ...errors import (
    DISK_FULL_ERRNOS,
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_OTHER,
    EXIT_RESOURCES,
    WrapError,
    unwritable_error,
)
from ...processes.helper_process import emit
from ...report_warning import ReportWarning

PARENT_POLL_S = 1.0


def run_command(
    work: Callable[[], Iterable[str | ReportWarning]], memory_hint: str = "Close other programs."
) -> int:
    """Emit the lines and warnings of ``work`` as they come, or its error; return the exit code.

    The process ends when the one that asked does.
    """
    # Not the caller's own id: where Python is started through a launcher, that is the parent.
    threading.Thread(target=exit_with_parent, args=(os.getppid(),), daemon=True).start()
    try:
        for line in work():
            if isinstance(line, ReportWarning):
                emit(warning=line.text, code=line.code)
            else:
                emit(line=line)
    except WrapError as error:
        emit(error=error.message, hint=error.hint)
        return error.exit_code
    except MemoryError:
        emit(error="Not enough memory.", hint=memory_hint)
        return EXIT_RESOURCES
    except ImportError as error:
        emit(
            error=f"The worker's Python lacks a package: {error}.",
            hint="pip install -r requirements-worker.txt there.",
        )
        return EXIT_OTHER
    except OSError as error:
        if error.errno in DISK_FULL_ERRNOS:
            full = unwritable_error(error.filename or "a file", error)
            emit(error=full.message, hint=full.hint)
            return full.exit_code
        emit(error=f"{error}.", hint="Check the path and its permissions.")
        return EXIT_OTHER
    return EXIT_DONE


def exit_with_parent(parent: int) -> None:
    """End this process when the one that asked has gone: nobody waits for the answer."""
    while os.getppid() == parent:
        time.sleep(PARENT_POLL_S)
    os._exit(EXIT_CANCELLED)
