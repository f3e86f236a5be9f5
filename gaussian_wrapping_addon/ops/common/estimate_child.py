# SPDX-License-Identifier: GPL-3.0-or-later
"""A question to the worker's Python: start the child, wait for what it says, or end it."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Callable
from typing import Any

from ...core.errors import WorkerError
from ...core.processes.spawn import kill_group, spawn
from .background import Lane

_endings = Lane()


def ask_child(
    command: list[str], begun: Callable[[subprocess.Popen[bytes]], bool], deadline_s: float
) -> tuple[list[dict[str, Any]], str]:
    """Run a child to its end; touches nothing of Blender.

    Parameters
    ----------
    begun : callable
        Takes the process; false where nobody waits for the answer any more, which ends it.

    Returns
    -------
    said : list of dict
        The JSON objects that it wrote, one a line.
    last_words : str
        The last line that it wrote to its terminal.

    Raises
    ------
    WorkerError
        It does not run, or takes too long.
    """
    try:
        process = spawn(command)
    except OSError as error:
        raise WorkerError(
            f"{command[0]} does not run: {error}.", "Choose another Python."
        ) from None
    if not begun(process):
        kill_group(process)
    try:
        output, words = process.communicate(timeout=deadline_s)
    except subprocess.TimeoutExpired:
        kill_group(process)
        raise WorkerError("The estimate took too long.", "Start the job without it.") from None
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
    """Start the thread that ends children, where the next one is ended by a timer."""
    _endings.start()


class Child:
    """A question that may be given up before it is answered."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self._guard = threading.Lock()
        self._wanted = True

    def ask(self, command: list[str], deadline_s: float) -> tuple[list[dict[str, Any]], str]:
        """Run a child to its end, in a thread; see :func:`ask_child`."""
        return ask_child(command, self._begun, deadline_s)

    def _begun(self, process: subprocess.Popen[bytes]) -> bool:
        with self._guard:
            self.process = process
            return self._wanted

    def end(self) -> None:
        """Give up: end the process in the background, or as soon as it begins."""
        with self._guard:
            self._wanted = False
            process = self.process
        if process is not None and process.poll() is None:
            _endings.submit(lambda: kill_group(process))
