# SPDX-License-Identifier: GPL-3.0-or-later
"""States of a job's parts, read again and again from ``parts/*.json`` of its folder.

Each file is written by the process that runs the part, perhaps on another computer. Only files that
changed are read again.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ...errors import WrapError
from ...files import is_real_folder
from .graph import PARTS_NAME, STATES_FOLDER, PartsGraph, PartState, read_parts, read_state

SILENT_S = 180.0
"""A running part without a sign of life for longer has lost its computer: several times the longest
time between two signs, and the clocks of two computers may differ by a minute."""
MAX_TEXT_CHARACTERS = 2000

DONE, RUNNING, FAILED, LEFT = "done", "running", "failed", "left"
COLUMNS = (DONE, RUNNING, FAILED, LEFT)

_COLUMN = {"DONE": DONE, "RUNNING": RUNNING, "FAILED": FAILED}


@dataclass(frozen=True)
class FailedPart:
    """A part that failed, for people."""

    name: str
    place: str
    error: str
    """What was wrong, with the next step."""


@dataclass(frozen=True)
class PartBoard:
    """How far a job's parts are."""

    counts: tuple[tuple[str, tuple[int, int, int, int]], ...] = ()
    """Of each kind, in the order of the list: parts done, running, failed and left."""
    failed: tuple[FailedPart, ...] = ()
    problem: str = ""
    """Why there is nothing to show."""

    @property
    def totals(self) -> tuple[int, int, int, int]:
        """Parts done, running, failed and left."""
        done, running, failed, left = (sum(row[k] for _, row in self.counts) for k in range(4))
        return done, running, failed, left

    @property
    def finished(self) -> bool:
        """Whether all parts are done."""
        return bool(self.counts) and sum(self.totals) == self.totals[0]


class PartReader:
    """Reads the parts of one job folder; keeps what did not change."""

    def __init__(self, root: Path, clock: Callable[[], float] = time.time) -> None:
        self.root = root
        self._clock = clock
        self._stamp: tuple[int, int] | None = None
        self._list: PartsGraph | None = None
        self._known: dict[str, tuple[tuple[int, int], PartState]] = {}

    def read(self) -> PartBoard:
        """Return how far the parts are; never raises for what the folder holds."""
        try:
            return self._read()
        except WrapError as error:
            return PartBoard(problem=str(error))
        except OSError as error:
            words = f"{error.filename or self.root} cannot be read: {error.strerror or error}."
            return PartBoard(problem=words)

    def _read(self) -> PartBoard:
        listed = self._part_list()
        states = self._states({part.name for part in listed.parts})
        now_s = self._clock()
        counts: dict[str, list[int]] = {}
        failed = []
        for part in listed.parts:
            state = states.get(part.name)
            column = _column_now(state, now_s)
            row = counts.setdefault(part.kind, [0] * len(COLUMNS))
            row[COLUMNS.index(column)] += 1
            if state is not None and column == FAILED:
                words = f"{state.error} {state.hint}".strip() or state.message
                failed.append(FailedPart(part.name, state.host, words[:MAX_TEXT_CHARACTERS]))
        rows = tuple((kind, (row[0], row[1], row[2], row[3])) for kind, row in counts.items())
        return PartBoard(rows, tuple(failed))

    def _part_list(self) -> PartsGraph:
        try:
            found = os.lstat(self.root / PARTS_NAME)
            stamp = (found.st_mtime_ns, found.st_size)
        except FileNotFoundError:
            stamp = None  # read_parts says so
        if self._list is None or stamp != self._stamp:
            self._list = None
            self._list = read_parts(self.root)
            self._stamp = stamp
        return self._list

    def _states(self, names: set[str]) -> dict[str, PartState]:
        known: dict[str, tuple[tuple[int, int], PartState]] = {}
        if not is_real_folder(self.root / STATES_FOLDER):
            return {}  # no part has begun
        with os.scandir(self.root / STATES_FOLDER) as entries:
            for entry in entries:
                name = entry.name.removesuffix(".json")
                if name == entry.name or name not in names:
                    continue
                try:
                    found = entry.stat(follow_symlinks=False)
                except OSError:
                    continue  # replaced at this moment
                stamp = (found.st_mtime_ns, found.st_size)
                before = self._known.get(name)
                if before is not None and before[0] == stamp:
                    known[name] = before
                    continue
                state = read_state(self.root, name)
                if state is not None:
                    known[name] = (stamp, state)
                elif before is not None:
                    known[name] = before
        self._known = known
        return {name: state for name, (_, state) in known.items()}


def _column_now(state: PartState | None, now_s: float) -> str:
    if state is None:
        return LEFT
    column = _COLUMN[state.state]
    if column == RUNNING and now_s - state.heartbeat_s > SILENT_S:
        return LEFT  # another computer will run it
    return column
