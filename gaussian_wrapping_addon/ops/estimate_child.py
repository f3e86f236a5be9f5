# SPDX-License-Identifier: GPL-3.0-or-later
"""A question to the worker's Python: start the child, wait for what it says. For threads."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from typing import Any

from ..core.errors import WorkerError
from ..core.processes.spawn import kill_group, spawn


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
