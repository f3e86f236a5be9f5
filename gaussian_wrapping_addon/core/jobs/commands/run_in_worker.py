# SPDX-License-Identifier: GPL-3.0-or-later
"""A command run in the worker's Python."""

from __future__ import annotations

import json
import logging
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

from ...errors import (
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_OTHER,
    EXIT_RESOURCES,
    MissingExtraError,
    WorkerError,
    WrapError,
    known_error,
)
from ...progress import ReportWarning
from ...worker.environment import not_started, package_error
from ...worker.helper_process import child_command, emit, ending_of, json_object, last_line
from ...worker.spawn import Caller, kill_group, spawn

# -- Start a command in the worker's Python and log what it says; the parent needs no packages ----
#
# The child writes one JSON object per line to stdout: ``{"message"}`` for progress, ``{"line"}``
# for a table, ``{"warning", "code"}``, and ``{"error", "hint"}`` at the end.

_logger = logging.getLogger("gaussian_wrapping")

ERROR_TAIL_BYTES = 2000


def run_in_worker(
    request: dict[str, Any], *, python: str, module: str, what: str, grace_s: float = 2.0
) -> int:
    """Run a command in the worker's Python, log its output, and return its exit code.

    Parameters
    ----------
    request : dict
        What the child's module takes; plain JSON values.
    python : str
        The worker's interpreter.
    module, what : str
        The child's module, and its name in errors; all commands use the protocol above.
    grace_s : float
        Time in which it may end by itself when this is interrupted.

    Raises
    ------
    WorkerError
        It does not start, or ends without reporting an error.
    """
    text = json.dumps(request, allow_nan=False)
    with tempfile.TemporaryFile() as error_file:
        try:
            process = spawn(child_command(module, text, python=python), stderr=error_file)
        except OSError as error:
            raise not_started(python, error) from None
        understood = error_shown = False
        try:
            assert process.stdout is not None
            for raw in process.stdout:
                values = json_object(raw)
                if values is not None:
                    understood = _log_line(values) or understood
                    error_shown = error_shown or "error" in values
            code = process.wait()
        except KeyboardInterrupt:
            _logger.info("cancelled")
            return EXIT_CANCELLED
        finally:
            kill_group(process, grace_s)
        if code not in (EXIT_DONE, *range(EXIT_OTHER, EXIT_CANCELLED + 1)) or (
            not error_shown if code else not understood
        ):
            error_file.seek(max(0, error_file.seek(0, os.SEEK_END) - ERROR_TAIL_BYTES))
            raise WorkerError(
                f"The {what} {ending_of(code)}: {last_line(error_file.read())}.",
                "Run batch.py doctor to check the worker's Python.",
            )
        return code


def _log_line(values: dict[str, Any]) -> bool:
    """Log one line of the child; tell whether it was one of the protocol."""
    if "error" in values:
        _logger.error("error: %s", f"{values['error']} {values.get('hint', '')}".strip())
    elif "warning" in values:
        _logger.info("warning: %s", values["warning"])
    elif "line" in values:
        _logger.info("%s", values["line"])
    elif "message" in values:
        _logger.info("[%5.1f %%] %s", 100 * float(values.get("fraction", 0)), values["message"])
    else:
        return False
    return True


# -- Run a command of the command line in the worker's Python and report lines or an error --------
#
# Writes one JSON object per line to stdout, which :mod:`.run_in_worker` reads.

PARENT_POLL_S = 1.0


def run_command(
    work: Callable[[], Iterable[str | ReportWarning]], memory_hint: str = "Close other programs.",
    leave: Callable[[], object] | None = None,
) -> int:  # fmt: skip
    """Emit the lines and warnings of ``work`` as they come, or its error; return the exit code.

    The process ends when its caller does. Before that, ``leave`` is called in another thread: it
    takes away what ``work`` has left elsewhere.
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
