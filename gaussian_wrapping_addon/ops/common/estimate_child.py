# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimates by the worker's Python: run a child process and parse its output, or end it."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Callable
from typing import Any

from ...core.errors import WorkerError
from ...core.processes.spawn import kill_group, spawn
from ...core.processes.worker_requirements import not_started
from .background import Lane

_endings = Lane()


def run_child(
    command: list[str],
    on_start: Callable[[subprocess.Popen[bytes]], bool],
    deadline_s: float,
    late: WorkerError | None = None,
) -> tuple[list[dict[str, Any]], str]:
    """Run a child to its end; touches nothing of Blender.

    Parameters
    ----------
    on_start : callable
        Receives the process; returns false if the estimate is no longer wanted, which ends it.
    late : WorkerError, optional
        Raised where it takes too long, in place of the error of an estimate.

    Returns
    -------
    messages : list of dict
        JSON objects from standard output, one a line.
    last_words : str
        The last line of standard error.

    Raises
    ------
    WorkerError
        The child does not start, or takes too long.
    """
    try:
        process = spawn(command)
    except OSError as error:
        raise not_started(command[0], error) from None
    if not on_start(process):
        kill_group(process)
    try:
        output, words = process.communicate(timeout=deadline_s)
    except subprocess.TimeoutExpired:
        kill_group(process)
        too_long = WorkerError("The estimate took too long.", "Start the job without it.")
        raise late or too_long from None
    found = []
    for line in output.decode(errors="replace").splitlines():
        try:
            values = json.loads(line)
        except ValueError:
            continue
        if isinstance(values, dict):
            found.append(values)
    last = words.decode(errors="replace").strip().splitlines()
    return found, last[-1] if last else ""


def get_ready() -> None:
    """Start the thread that ends children, ahead of a timer that uses it."""
    _endings.start()


class Child:
    """A child process that can be cancelled before it has answered."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self._guard = threading.Lock()
        self._wanted = True

    def run(
        self, command: list[str], deadline_s: float, late: WorkerError | None = None
    ) -> tuple[list[dict[str, Any]], str]:
        """Run a child to its end, in a thread; see :func:`run_child`."""
        return run_child(command, self._on_start, deadline_s, late)

    def _on_start(self, process: subprocess.Popen[bytes]) -> bool:
        with self._guard:
            self.process = process
            return self._wanted

    def end(self) -> None:
        """Cancel: end the process in the background, or as soon as it has started."""
        with self._guard:
            self._wanted = False
            process = self.process
        if process is not None and process.poll() is None:
            _endings.submit(lambda: kill_group(process))
