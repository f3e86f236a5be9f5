# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of the shown job, read every few seconds while a panel shows them; drawn from memory.

A thread reads the job folder, which may be on a network. The timer goes out once nobody draws the
parts any more.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from ...core.farm.part_states import PartBoard, PartReader
from ...core.jobs.parts.graph import PARTS_NAME
from ..common import background, known_jobs
from ..common.background import Lane, Task
from ..common.redrawing import redraw_sidebars

_logger = logging.getLogger(__name__)

EVERY_S: Final = 3.0
IDLE_EVERY_S: Final = 15.0
"""Where nothing is left to happen, or there are no parts."""
MAX_FOLDERS: Final = 20
_NEVER_S: Final = float("-inf")


@dataclass(frozen=True)
class Look:
    """What a job folder says of its parts."""

    board: PartBoard

    @property
    def moves(self) -> bool:
        """Whether something is left to happen."""
        return bool(self.board.counts) and not self.board.finished


@dataclass
class _Watched:
    reader: PartReader
    asked_s: float = _NEVER_S
    read_s: float = _NEVER_S
    look: Look | None = None
    reading: Task[Look | None] | None = None


_readings = Lane()
_watched: dict[str, _Watched] = {}


def look_at(folder: str) -> Look | None:
    """Return the parts of a job folder as last read, for panels; None if there are none.

    Reads nothing. Asks for a new reading where this one is old.

    Parameters
    ----------
    folder : str
        Absolute path; ``""`` for none.
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
        start()
    return watched.look


def start() -> None:
    """Read in the background what was asked for."""
    _readings.start()  # the timer starts no thread
    background.watch(tick)


def tick() -> bool:
    """Read what is due, from the add-on's timer; return whether to go on."""
    again = False
    for folder, watched in list(_watched.items()):
        if watched.reading is not None:
            again = _collected(watched) or again
        elif watched.asked_s >= watched.read_s and _is_due(watched):
            if known_jobs.is_named(Path(folder)):  # a .blend from elsewhere names any folder
                watched.reading = _readings.submit(partial(_read, watched.reader))
                again = True
            else:
                watched.read_s = time.monotonic()
        elif watched.look is not None and watched.look.moves:
            # Drawn since it was read, or drawn right now: it will be due.
            wait_s = time.monotonic() - watched.read_s
            again = again or watched.asked_s >= watched.read_s or wait_s < EVERY_S
    return again


def stop() -> None:
    """Forget everything."""
    _watched.clear()
    _readings.stop()


def _is_due(watched: _Watched) -> bool:
    every_s = EVERY_S if watched.look is not None and watched.look.moves else IDLE_EVERY_S
    return time.monotonic() - watched.read_s >= every_s


def _collected(watched: _Watched) -> bool:
    """Keep a finished reading; return whether there is more to come."""
    reading = watched.reading
    if reading is None or not reading.finished():
        return True
    watched.reading, watched.read_s = None, time.monotonic()
    try:
        watched.look = reading.result()
    except Exception:  # whatever the folder contains
        _logger.exception("reading the parts in %s", watched.reader.root)
        watched.look = None
    redraw_sidebars()  # a panel that is shown asks again
    return watched.look is not None and watched.look.moves


def _read(reader: PartReader) -> Look | None:
    """Read the parts of a job folder; runs in a thread."""
    return Look(reader.read()) if (reader.root / PARTS_NAME).exists() else None
