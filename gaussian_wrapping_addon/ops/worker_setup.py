# SPDX-License-Identifier: GPL-3.0-or-later
"""The worker's environment as Blender sees it: is it there, what does a set-up do just now.

Nothing here waits: Pythons are looked for in a thread, a set-up runs in a process, and one timer
looks after both. The state outlives the preferences' window.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ..core import limits, worker_environment
from ..core.errors import UsageError, WrapError
from ..core.jobs.client import PYTHON_VARIABLE, worker_python
from ..core.jobs.job_folder import JobStatus
from ..core.setup.client import SetupClient
from ..core.setup.commands import SetupRequest, cuda_present
from ..core.setup.install import remove, repair_request
from ..core.setup.pythons import FoundPython, find_pythons
from ..core.worker_environment import WorkerEnvironment
from ..core.worker_requirements import requirements_file
from . import doctor
from .preferred_worker import worker_choice
from .redrawing import redraw

_logger = logging.getLogger(__name__)

POLL_S = 0.3
READY_FOR_S = 2.0
"""For so long an answer of :func:`worker_ready` is taken as it was."""


@dataclass
class _State:
    pythons: list[FoundPython] = field(default_factory=list)
    has_cuda: bool = False
    search: threading.Thread | None = None
    searched: bool = False
    client: SetupClient | None = None
    removing: threading.Thread | None = None
    status: JobStatus | None = None
    cancel_asked_s: float | None = None
    problem: str = ""
    ready_key: tuple[str, str] | None = None
    ready_s: float = -1e9


_state = _State()


def environment() -> WorkerEnvironment:
    """Return the environment of this add-on in this Blender; it need not exist."""
    package = __package__.rpartition(".")[0]
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
    if key != _state.ready_key or now_s - _state.ready_s > READY_FOR_S:
        try:
            worker_python(preference)
            _state.problem = ""
        except WrapError as error:
            _state.problem = str(error)
        _state.ready_key, _state.ready_s = key, now_s
    return _state.problem


def forget_answer() -> None:
    """Look anew at the next question whether a worker is there."""
    _state.ready_s = -1e9


def pythons() -> tuple[FoundPython, ...]:
    """Return the Pythons that were found."""
    return tuple(_state.pythons)


def has_cuda() -> bool:
    """Tell whether an NVIDIA driver was found."""
    return _state.has_cuda


def is_searching() -> bool:
    """Tell whether Pythons are being looked for, or have not been yet."""
    return not _state.searched


def look_around() -> None:
    """Look for Pythons once, in a thread; drawing may call this."""
    if not _state.searched and _state.search is None:
        _state.search = threading.Thread(target=_search, args=(sys.executable,), daemon=True)
        _state.search.start()
        _start_timer()


def _search(own: str) -> None:
    """Thread: touches nothing of Blender."""
    try:
        _state.pythons, _state.has_cuda = find_pythons(own), cuda_present()
    except Exception:  # without an answer the search would never end
        _logger.exception("looking for Pythons")
    _state.searched = True


def status() -> JobStatus | None:
    """Return how far the set-up of this session is, or how it ended; None before any."""
    return _state.status


def is_busy() -> bool:
    """Tell whether a set-up or a removal is at work."""
    return _state.client is not None or _state.removing is not None


def request_for(python: str, torch: str, wheel_folder: str) -> SetupRequest:
    """Return what a set-up with these choices is.

    Raises
    ------
    UsageError
        The add-on's list of packages is missing.
    """
    folder = bpy.path.abspath(wheel_folder) if wheel_folder else ""
    root = str(environment().root)
    return SetupRequest(root, python, str(requirements_file()), torch, folder)


def start(request: SetupRequest) -> None:
    """Begin a set-up.

    Raises
    ------
    WrapError
        The Python or the folder cannot be used, or a set-up is at work.
    """
    if is_busy():
        raise UsageError("A set-up is running.", "Cancel it or wait for it.")
    _state.client = SetupClient.start(request)
    _state.status, _state.cancel_asked_s = _state.client.poll(), None
    _start_timer()


def repair(wheel_folder: str) -> None:
    """Put back what is missing or broken in the environment that is there.

    Raises
    ------
    WrapError
        There is none, or its Python has gone and no other is known.
    """
    python = _state.pythons[0].path if _state.pythons else ""
    start(repair_request(request_for(python, "cpu", wheel_folder)))


def cancel() -> None:
    """Ask the set-up to stop; it is ended by force when it does not."""
    if _state.client is not None and _state.cancel_asked_s is None:
        _state.client.cancel()
        _state.cancel_asked_s = time.monotonic()


def is_cancelling() -> bool:
    """Tell whether the set-up was asked to stop."""
    return _state.cancel_asked_s is not None


def start_removing() -> None:
    """Delete the environment in a thread: there are tens of thousands of files.

    Raises
    ------
    UsageError
        We have not made it, or a set-up is at work.
    """
    target = environment()
    if is_busy():
        raise UsageError("A set-up is running.", "Cancel it or wait for it.")
    if not target.is_ours():
        remove(target)  # says why not
    _state.status = JobStatus("RUNNING", "remove", 0.0, "Removing the worker")
    _state.removing = threading.Thread(target=_remove, args=(target,), daemon=True)
    _state.removing.start()
    _start_timer()


def _remove(target: WorkerEnvironment) -> None:
    """Thread: touches nothing of Blender."""
    try:
        remove(target)
        _state.status = JobStatus("DONE", "remove", 1.0)
    except WrapError as error:
        _state.status = JobStatus("FAILED", "remove", error=error.message, hint=error.hint)
    except OSError as error:
        _state.status = JobStatus(
            "FAILED", "remove", error=f"{error.strerror}: {error.filename}.", hint="Try again."
        )


def _start_timer() -> None:
    if not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=POLL_S, persistent=True)


def tick() -> float | None:
    """Timer: take what is new, redraw, and go on while something is at work."""
    before = (_state.status, _state.search is None, _state.removing is None)
    if _state.search is not None and not _state.search.is_alive():
        _state.search = None
    if _state.removing is not None and not _state.removing.is_alive():
        _state.removing = None
        forget_answer()
    if _state.client is not None:
        _poll(_state.client)
    if before != (_state.status, _state.search is None, _state.removing is None):
        redraw("PREFERENCES", "VIEW_3D")
    return POLL_S if is_busy() or _state.search is not None else None


def _poll(client: SetupClient) -> None:
    _state.status = client.poll()
    if _state.status.active:
        asked_s = _state.cancel_asked_s
        if asked_s is not None and time.monotonic() - asked_s > limits.CANCEL_GRACE_S:
            _state.cancel_asked_s = time.monotonic()
            # It waits for the process to end, which Blender must not.
            threading.Thread(target=client.kill, daemon=True).start()
        return
    _state.client = None
    forget_answer()
    if _state.status.state == "DONE":
        with contextlib.suppress(WrapError):
            doctor.start(worker_choice(bpy.context).python)


def stop() -> None:
    """Take the timer out and end a set-up; what it has installed stays for the next one."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    if _state.client is not None:
        _state.client.cancel()
        threading.Thread(target=_state.client.kill, daemon=True).start()
        _state.client = None
    _state.status, _state.cancel_asked_s = None, None
    forget_answer()
