# SPDX-License-Identifier: GPL-3.0-or-later
"""The worker's environment as Blender sees it: is it there, what does a set-up do just now.

Nothing here waits: threads look for Pythons, set up and remove, and one timer looks after them.
The state outlives the preferences' window.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...core.errors import UsageError, WrapError
from ...core.jobs.client import PYTHON_VARIABLE, worker_python
from ...core.processes import worker_environment
from ...core.processes.worker_environment import WorkerEnvironment
from ...core.processes.worker_requirements import requirements_file
from ...core.setup.commands import SetupRequest, cuda_present
from ...core.setup.install import SetupTask
from ...core.setup.pythons import FoundPython, find_pythons
from ..common.addon import addon_package
from ..common.redrawing import redraw
from . import worker_check
from .preferred_worker import worker_choice

POLL_S = 0.3
READY_FOR_S = 2.0
"""For so long an answer of :func:`worker_ready` is taken as it was."""


@dataclass
class State:
    """What was found, and what is at work in this session; others only read it."""

    pythons: list[FoundPython] | None = None
    """None while they are not looked for yet."""
    has_cuda: bool = False
    search: threading.Thread | None = None
    task: SetupTask | None = None
    is_busy: bool = False
    """Whether the task's end is still to be dealt with."""
    problem: str = ""
    ready_key: tuple[str, str] | None = None
    ready_s: float = -1e9


state = State()


def environment() -> WorkerEnvironment:
    """Return the environment of this add-on in this Blender; it need not exist."""
    package = addon_package()
    with contextlib.suppress(ValueError, OSError):  # ValueError: not installed as an extension
        return WorkerEnvironment(Path(bpy.utils.extension_path_user(package, path="worker")))
    return WorkerEnvironment(worker_environment.default_root())


def worker_ready() -> bool:
    """Tell whether jobs have a Python to run in; cheap enough for every redraw."""
    return not worker_problem()


def worker_problem() -> str:
    """Return why jobs have no Python to run in, and the next step; ``""`` where they have one."""
    preference = worker_choice(bpy.context).python
    key = (preference, os.environ.get(PYTHON_VARIABLE, ""))
    now_s = time.monotonic()
    if key != state.ready_key or now_s - state.ready_s > READY_FOR_S:
        try:
            worker_python(preference)
            state.problem = ""
        except WrapError as error:
            state.problem = str(error)
        state.ready_key, state.ready_s = key, now_s
    return state.problem


def forget_answer() -> None:
    """Look anew at the next question whether a worker is there."""
    state.ready_s = -1e9


def look_around() -> None:
    """Look for Pythons once, in a thread; drawing may call this."""
    if state.search is None:
        state.search = threading.Thread(target=_search, args=(sys.executable,), daemon=True)
        state.search.start()
        _start_timer()


def _search(own: str) -> None:
    """Thread: touches nothing of Blender."""
    state.has_cuda = cuda_present()
    state.pythons = find_pythons(own)


def request_for(python: str, torch: str, wheel_folder: str) -> SetupRequest:
    """Return what a set-up with these choices is.

    Raises
    ------
    UsageError
        The add-on's list of packages is missing.
    """
    folder = bpy.path.abspath(wheel_folder) if wheel_folder else ""
    return SetupRequest(str(environment().root), python, str(requirements_file()), torch, folder)


def start(request: SetupRequest, *, removes: bool = False) -> None:
    """Begin a set-up or a removal.

    Raises
    ------
    UsageError
        One is at work.
    """
    if state.task is not None and state.task.status.active:
        raise UsageError("A set-up is running.", "Cancel it or wait for it.")
    state.task, state.is_busy = SetupTask(request, removes=removes), True
    state.task.start()
    _start_timer()


def _start_timer() -> None:
    if not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=POLL_S, persistent=True)


def tick() -> float | None:
    """Timer: redraw, and go on while something is at work."""
    if state.is_busy and state.task is not None and not state.task.status.active:
        state.is_busy = False
        forget_answer()
        if state.task.status.state == "DONE" and not state.task.removes:
            with contextlib.suppress(WrapError):
                worker_check.start(worker_choice(bpy.context).python)
    redraw("PREFERENCES", "VIEW_3D")
    searching = state.search is not None and state.search.is_alive()
    return POLL_S if state.is_busy or searching else None


def stop() -> None:
    """Take the timer out and cancel a set-up."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    if state.task is not None:
        state.task.cancel()
    state.is_busy = False
    forget_answer()
