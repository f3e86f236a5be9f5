# SPDX-License-Identifier: GPL-3.0-or-later
"""State of the worker's environment: readiness, search for Pythons, set-up and removal.

Nothing here waits: Pythons are searched, set-ups and removals run in the background
(``ops/common/background.py``). The state outlives the preferences' window.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...core.errors import UsageError, WrapError
from ...core.jobs.client import PYTHON_VARIABLE, worker_python
from ...core.processes import worker_environment
from ...core.processes.worker_environment import WorkerEnvironment
from ...core.processes.worker_extras import read_extra_names
from ...core.processes.worker_requirements import requirements_file
from ...core.setup.commands import SetupRequest, all_commands, as_line, cuda_present
from ...core.setup.install import SetupTask
from ...core.setup.pythons import OLDEST, FoundPython, find_pythons
from ..common import background
from ..common.addon import addon_package
from ..common.background import Lane
from ..common.redrawing import redraw
from . import worker_check
from .preferred_worker import worker_choice

_logger = logging.getLogger(__name__)

READY_FOR_S = 2.0
"""Lifetime of a cached result of :func:`worker_problem`."""


@dataclass
class State:
    """Findings and running work of this session; other modules only read it."""

    pythons: list[FoundPython] | None = None
    """None until the search has ended."""
    has_cuda: bool = False
    has_searched: bool = False
    """Whether a search for Pythons has begun."""
    task: SetupTask | None = None
    is_busy: bool = False
    """Whether the end of the task is still to be handled."""
    problem: str = ""
    ready_key: tuple[str, str] | None = None
    ready_s: float = -1e9


state = State()
_searches, _setups, _endings = Lane(), Lane(), Lane()


def environment() -> WorkerEnvironment:
    """Return the environment of this add-on in this Blender; it need not exist."""
    package = addon_package()
    with contextlib.suppress(ValueError, OSError):  # ValueError: not installed as an extension
        return WorkerEnvironment(Path(bpy.utils.extension_path_user(package, path="worker")))
    return WorkerEnvironment(worker_environment.default_root())


def worker_ready() -> bool:
    """Return whether jobs have a Python to run in; cheap enough for every redraw."""
    return not worker_problem()


def worker_problem() -> str:
    """Return why jobs have no Python to run in, and the next step; ``""`` if they have one."""
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


def forget_problem() -> None:
    """Discard the cached result of :func:`worker_problem`."""
    state.ready_s = -1e9


def search_pythons() -> None:
    """Search for Pythons once, in the background; drawing may call this."""
    if not state.has_searched:
        state.has_searched = True
        own = sys.executable
        _searches.submit(
            lambda: (cuda_present(), find_pythons(own)), _keep_search, failed=_search_failed
        )
    if not state.is_busy and state.task is not None and state.task.status.active:
        state.is_busy = True  # it went on while the add-on was disabled
        background.watch(tick)


def _search_failed(error: Exception) -> None:
    _logger.error("The search for Python installations failed.", exc_info=error)
    _keep_search((False, []))


def _keep_search(found: tuple[bool, list[FoundPython]]) -> None:
    state.has_cuda, state.pythons = found
    redraw("PREFERENCES", "VIEW_3D")


def request_for(
    python: str,
    torch: str,
    wheel_folder: str,
    extras: Iterable[str] = (),
    *,
    adds: bool = False,
) -> SetupRequest:
    """Return the request of a set-up with these choices, or of adding extras to the present one.

    Raises
    ------
    UsageError
        The add-on's list of packages is missing.
    """
    folder = bpy.path.abspath(wheel_folder) if wheel_folder else ""
    root, requirements = str(environment().root), str(requirements_file())
    names = read_extra_names(",".join(extras))
    return SetupRequest(root, python, requirements, torch, folder, names, adds)


def lines_that_add(extra: str, wheel_folder: str) -> list[str]:
    """Return the commands that add an extra to the present environment; starts no process.

    Raises
    ------
    UsageError
        There is no environment to add to.
    """
    path = str(environment().marker().get("python", ""))
    unknown = FoundPython(path, (*OLDEST, 0))
    python = next((p for p in state.pythons or () if p.path == path), unknown)
    request = request_for(path, "cpu", wheel_folder, (extra,), adds=True)
    return [as_line(command) for command in all_commands(request, python)]


def start(request: SetupRequest, *, removes: bool = False) -> None:
    """Start a set-up or a removal.

    Raises
    ------
    UsageError
        One is running.
    """
    if state.task is not None and state.task.status.active:
        raise UsageError("A set-up is running.", "Cancel it or wait for it.")
    state.task, state.is_busy = SetupTask(request, removes=removes), True
    _setups.submit(state.task.run)
    _endings.start()  # now: cancelling starts no thread
    background.watch(tick)


def cancel() -> None:
    """Cancel a set-up; its process is ended in the background."""
    if state.task is not None and state.task.status.active:
        state.task.is_cancelling = True
        _endings.submit(state.task.cancel)


def tick() -> bool:
    """Redraw, and handle the end of a set-up; return whether one is still running."""
    if state.is_busy and state.task is not None and not state.task.status.active:
        state.is_busy = False
        forget_problem()
        if state.task.status.state == "DONE" and not state.task.removes:
            with contextlib.suppress(WrapError):
                worker_check.start(worker_choice(bpy.context).python)
    redraw("PREFERENCES", "VIEW_3D")
    return state.is_busy


def stop() -> None:
    """Cancel a set-up and a search."""
    cancel()
    _searches.cancel()
    state.has_searched = state.pythons is not None
    state.is_busy = False
    forget_problem()
