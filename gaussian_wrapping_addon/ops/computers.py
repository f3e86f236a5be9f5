# SPDX-License-Identifier: GPL-3.0-or-later
"""Farms tested and submitted to; parts of the shown job."""

from __future__ import annotations

import json
import logging
import os
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import bpy

from ..core.errors import UsageError, WorkerError, WrapError
from ..core.farm.addresses import scheduler_address
from ..core.files import real_path
from ..core.jobs.client import worker_python
from ..core.jobs.parts.graph import PARTS_NAME
from ..core.jobs.parts.states import PartBoard, PartReader
from ..core.names import SHARED_VARIABLE
from ..core.worker.helper_process import child_command
from . import addon, background
from .addon import ReportsErrors, properties_of, redraw_sidebars, tr
from .background import Child, Lane, Task
from .panel_settings import certificates_of, output_of, source_of
from .worker_setup import WorkerChoice, worker_choice

# -- Requests to a farm in a thread, one at a time, and their outcome for the panel ---------------


_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """How the last request ended."""

    good: bool
    lines: tuple[str, ...]
    """Sentences: what was found, or what was wrong and the next step."""
    rows: tuple[tuple[bool, str], ...] = ()
    """Of each computer: whether it can be used, and a sentence."""


@dataclass
class _Memory:
    outcome: Outcome | None = None
    about: str = ""
    """The address or folder that the last request is about."""


_lane = Lane(of_file=True)
_memory = _Memory()


def is_busy() -> bool:
    """Return whether a request runs."""
    return _lane.busy


def asks_about(about: str) -> bool:
    """Return whether a request runs that is about an address or folder."""
    return _lane.busy and _memory.about == about


def outcome(about: str) -> Outcome | None:
    """Return how the last request ended, if it was about this address or folder."""
    found = _memory.outcome
    return found if found is not None and _memory.about == about else None


def stop() -> None:
    """Forget everything; a request that runs ends by itself within seconds."""
    _lane.stop()
    _memory.outcome = None
    _watched.clear()
    _readings.stop()


def _keep(outcome: Outcome) -> None:
    _memory.outcome = outcome
    redraw_sidebars()


def _keep_failure(error: Exception) -> None:
    if not isinstance(error, WrapError | OSError):
        _logger.error("a request to a farm", exc_info=error)
    lines = (error.message, error.hint) if isinstance(error, WrapError) else (str(error),)
    _keep(Outcome(False, tuple(filter(None, lines))))


# -- Check each worker of a Dask cluster in the background, by a process of the worker's Python


MODULE = "jobs.commands.farm_doctor"
LIMIT_S = 120.0
"""Within which each worker must answer."""
DEADLINE_S = LIMIT_S + 60.0
MAX_ROWS = 12
MAX_TEXT = 600


def start(scene: bpy.types.Scene, choice: WorkerChoice) -> None:
    """Ask all workers of a scheduler in the background; the panel shows a row for each.

    Raises UsageError: the address cannot be used, there is no folder to test, or the certificates
    are on another computer; WorkerError: no worker is set up on this computer.
    """
    about = properties_of(scene).computers.dask_address
    address = scheduler_address(about)
    if not address.is_this_computer and not bpy.app.online_access:
        raise UsageError(
            "Blender may not go online.", "Turn on Allow Online Access in Preferences, System."
        )
    request = {
        "address": str(address), "certificates": certificates_of(scene),
        "folder": str(folder_of_jobs(scene)), "limit_s": LIMIT_S,
    }  # fmt: skip
    python = worker_python(choice.python)
    command, child = child_command(MODULE, json.dumps(request), python=python), Child()
    late = WorkerError("The test took too long.", "Look at the scheduler, then test again.")
    _lane.cancel()
    _memory.outcome, _memory.about = None, about
    _lane.submit(
        lambda: child.run(command, DEADLINE_S, late),
        lambda told: _keep(outcome_of(*told)),
        failed=_keep_failure,
        end=child.end,
    )


def folder_of_jobs(scene: bpy.types.Scene) -> Path:
    """Return the folder that workers must see: where the scene's job is or will be written.

    Raises UsageError: neither photos nor the environment name one.
    """
    if properties_of(scene).source:
        folder = output_of(scene, source_of(scene))
    elif os.environ.get(SHARED_VARIABLE):
        folder = real_path(os.environ[SHARED_VARIABLE])
    else:
        raise UsageError(
            "No folder is known that all computers share.",
            f"Choose photos in it, or set {SHARED_VARIABLE}.",
        )
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    return folder


def outcome_of(messages: list[dict[str, Any]], last_words: str) -> Outcome:
    """Return what the panel shows of what the process has written.

    Parameters
    ----------
    messages : list of dict
        ``{"worker": {...}}`` for each worker, ``{"error", "hint"}``.
    last_words : str
        The last line of its standard error.
    """
    workers = [m["worker"] for m in messages if isinstance(m.get("worker"), dict)]
    errors = [m for m in messages if m.get("error")]
    rows = sorted((bool(w.get("good")), _sentence(w)) for w in workers)  # bad ones first
    if workers:
        good = sum(is_good for is_good, _ in rows)
        lines = [tr("{good} of {count} workers can be used.", good=good, count=len(rows))]
        return Outcome(good == len(rows), tuple(lines), tuple(rows[:MAX_ROWS]))
    if errors:
        texts = (str(errors[-1].get(key, ""))[:MAX_TEXT] for key in ("error", "hint"))
        return Outcome(False, tuple(filter(None, texts)))
    words = last_words[:MAX_TEXT] or "no output"
    return Outcome(False, (f"The test ended without a result: {words}.", "See Check Worker."))


def _sentence(worker: dict[str, Any]) -> str:
    name = str(worker.get("name", ""))[:MAX_TEXT]
    if not worker.get("good"):
        problems = worker.get("problems")
        told = " ".join(map(str, problems)) if isinstance(problems, list) else ""
        return f"{name}: {told}"[:MAX_TEXT]
    return tr(
        "{name}: {cores} cores, {memory} GiB, {gpu}",
        name=name, cores=worker.get("cores", 0), memory=worker.get("memory_gib", 0),
        gpu=str(worker.get("gpu") or tr("no GPU"))[:MAX_TEXT],
    )  # fmt: skip


# -- Parts of the shown job, read every few seconds while a panel shows them; drawn from memory
#
# A thread reads the job folder, which may be on a network. The timer goes out once nobody draws
# the parts any more.


EVERY_S: Final = 3.0
IDLE_EVERY_S: Final = 15.0
"""Where nothing is left to happen, or there are no parts."""
MAX_FOLDERS: Final = 20
_NEVER_S: Final = float("-inf")


def _moves(board: PartBoard | None) -> bool:
    """Return whether something is left to happen."""
    return board is not None and bool(board.counts) and not board.finished


@dataclass
class _Watched:
    reader: PartReader
    asked_s: float = _NEVER_S
    read_s: float = _NEVER_S
    board: PartBoard | None = None
    reading: Task[PartBoard | None] | None = None


_readings = Lane()
_watched: dict[str, _Watched] = {}


def look_at(folder: str) -> PartBoard | None:
    """Return the parts of a job folder as last read, for panels; None if there are none.

    Reads nothing. Asks for a new reading where this one is old.

    ``folder``: absolute path; ``""`` for none.
    """
    if not folder:
        return None
    watched = _watched.get(folder)
    if watched is None:
        while len(_watched) >= MAX_FOLDERS:
            _watched.pop(next(iter(_watched)))
        watched = _watched[folder] = _Watched(PartReader(Path(folder)))
    watched.asked_s = time.monotonic()
    if _is_due(watched):
        _readings.start()  # the timer starts no thread
        background.watch(tick)
    return watched.board


def tick() -> bool:
    """Read what is due, from the add-on's timer; return whether to go on."""
    again = False
    for folder, watched in list(_watched.items()):
        if watched.reading is not None:
            again = _collected(watched) or again
        elif watched.asked_s >= watched.read_s and _is_due(watched):
            if addon.is_named(Path(folder)):  # a .blend from elsewhere names any folder
                watched.reading = _readings.submit(partial(_read, watched.reader))
                again = True
            else:
                watched.read_s = time.monotonic()
        elif _moves(watched.board):
            # Drawn since it was read, or drawn right now: it will be due.
            wait_s = time.monotonic() - watched.read_s
            again = again or watched.asked_s >= watched.read_s or wait_s < EVERY_S
    return again


def _is_due(watched: _Watched) -> bool:
    every_s = EVERY_S if _moves(watched.board) else IDLE_EVERY_S
    return time.monotonic() - watched.read_s >= every_s


def _collected(watched: _Watched) -> bool:
    """Keep a finished reading; return whether there is more to come."""
    reading = watched.reading
    if reading is None or not reading.finished():
        return True
    watched.reading, watched.read_s = None, time.monotonic()
    try:
        watched.board = reading.result()
    except Exception:  # whatever the folder contains
        _logger.exception("reading the parts in %s", watched.reader.root)
        watched.board = None
    redraw_sidebars()  # a panel that is shown asks again
    return _moves(watched.board)


def _read(reader: PartReader) -> PartBoard | None:
    """Read the parts of a job folder; runs in a thread."""
    return reader.read() if (reader.root / PARTS_NAME).exists() else None


# -- The operator of the panel "Computers" --------------------------------------------------------


class GWRAP_OT_test_computers(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.test_computers"
    bl_label = "Test"
    bl_description = "Ask in the background whether these computers can run jobs"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if properties_of(context.scene).computers.kind == "THIS":
            return "Choose Dask to test an address"
        return "A request is running; it takes seconds" if is_busy() else ""

    def work(self, context: bpy.types.Context) -> None:
        start(context.scene, worker_choice(context))


CLASSES: Final = (GWRAP_OT_test_computers,)
