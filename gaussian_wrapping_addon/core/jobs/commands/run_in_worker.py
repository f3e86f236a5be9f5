# SPDX-License-Identifier: GPL-3.0-or-later
"""Start a command in the worker's Python and log what it says; the parent needs no packages.

The child writes one JSON object per line to stdout: ``{"message"}`` for progress, ``{"line"}`` for
a table, ``{"warning", "code"}``, and ``{"error", "hint"}`` at the end.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
from typing import Any

from ...errors import EXIT_CANCELLED, EXIT_DONE, EXIT_OTHER, WorkerError
from ...processes.helper_process import child_command
from ...processes.spawn import kill_group, spawn
from ...processes.worker_requirements import not_started

_logger = logging.getLogger("gaussian_wrapping")

ERROR_TAIL_BYTES = 2000


def run_in_worker(
    request: dict[str, Any],
    *,
    python: str,
    module: str,
    what: str,
    grace_s: float = 2.0,
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
                values = _parse(raw)
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
            error_lines = error_file.read().decode(errors="replace").strip().splitlines()
            reason = f"was stopped by signal {-code}" if code < 0 else f"ended with code {code}"
            raise WorkerError(
                f"The {what} {reason}: {error_lines[-1] if error_lines else 'no output'}.",
                "Run batch.py doctor to check the worker's Python.",
            )
        return code


def _parse(raw: bytes) -> dict[str, Any] | None:
    try:
        values = json.loads(raw)
    except (ValueError, RecursionError):
        return None
    return values if isinstance(values, dict) else None


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
