# SPDX-License-Identifier: GPL-3.0-or-later
"""Walk the parts of a job: start what is ready, take what has ended, plan what came to light.

A part that may work elsewhere is begun again, at most :data:`MOST_ATTEMPTS` times in all. One that
never will holds up what needs it; everything else is done first.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from ...errors import EXIT_CANCELLED, EXIT_DONE, Cancelled, WorkerError, WrapError
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from .engine import Engine, Outcome
from .exit_codes import MAY_WORK_ELSEWHERE, OTHER_CODE
from .graph import Part, PartsGraph, write_parts
from .part_runner import planned_tiles
from .part_state import PartState, keep_states, read_state, state_path
from .planning import PlannedTiles, fixed_tiles, plan_parts

_logger = logging.getLogger(__name__)

MOST_ATTEMPTS = 3
POLL_S = 0.25
HERE = ("bake", "export")
"""Kinds that change the result of a job: only the process that holds the folder runs them."""
CHECKED_AGAIN = ("cameras", "masks")
"""Kinds whose input people change between two runs: photos and masks. Where nothing has changed,
they are finished at once."""


class PartError(WrapError):
    """Parts of a job have failed for good.

    Parameters
    ----------
    outcome : Outcome
        Of the first of them.
    count : int
        How many there are.
    """

    can_resume = True

    def __init__(self, outcome: Outcome, count: int) -> None:
        where = f" on {outcome.place}" if outcome.place else ""
        more = f" {count - 1} more failed." if count > 1 else ""
        super().__init__(
            f"Part {outcome.part.name} failed{where}: {outcome.error}{more}",
            f"{outcome.hint} Everything else is done: resume makes what is missing.".strip(),
        )


@dataclass
class Walk:
    """One walk through the parts of a job.

    Parameters
    ----------
    engine, here : Engine
        What runs most parts, and what runs those of :data:`HERE`; may be the same.
    report : callable
        Takes the share of the job that is done, the parts that run, and how many are done.
    is_cancelled : callable
    """

    folder: JobFolder
    job: JobFile
    engine: Engine
    here: Engine
    report: Callable[[float, Mapping[str, Part], int], None]
    is_cancelled: Callable[[], bool]
    graph: PartsGraph = field(init=False)
    _tiles: dict[str, PlannedTiles] = field(default_factory=dict)
    _done: set[str] = field(default_factory=set)
    _running: dict[str, Part] = field(default_factory=dict)
    _failed: dict[str, Outcome] = field(default_factory=dict)
    _attempts: dict[str, int] = field(default_factory=dict)
    _earlier: dict[str, PartState] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._tiles = fixed_tiles(self.job)
        self._plan()
        if self.engine.trusts_states:
            self._earlier = self._finished_earlier()
        kinds = {part.name: part.kind for part in self.graph.parts}
        kept = {name for name in self._earlier if kinds[name] not in CHECKED_AGAIN}
        keep_states(self.folder.root, kept)

    def run(self) -> None:
        """Run all parts.

        Raises
        ------
        Cancelled
            The job was cancelled.
        PartError
            Parts failed for good; all that do not need them are done.
        WrapError
            What an engine raises.
        """
        while True:
            if self.is_cancelled():
                raise Cancelled()
            self._start_ready()
            if not self._running:
                break
            for engine in self._at_work():
                for outcome in engine.wait(POLL_S):
                    self._take(outcome)
            self.report(self._fraction(), self._running, len(self._done))
        if self._failed:
            raise PartError(next(iter(self._failed.values())), len(self._failed))
        if len(self._done) < len(self.graph.parts):
            raise WorkerError("Parts of the job wait for each other.", "Start the job again.")

    def _at_work(self) -> list[Engine]:
        engines = [self._engine_of(part) for part in self._running.values()]
        return [e for i, e in enumerate(engines) if not any(e is other for other in engines[:i])]

    def _plan(self) -> None:
        self.graph = plan_parts(self.folder.root, self.job, self._tiles)
        write_parts(self.folder.root, self.graph)

    def _finished_earlier(self) -> dict[str, PartState]:
        """Return the states of parts that an interrupted walk of the same plan has finished."""
        for part in self.graph.parts:
            if part.kind == "plan":
                self._note_tiles(part)
        self._plan()
        root = self.folder.root
        states = {part.name: read_state(root, part.name) for part in self.graph.parts}
        return {
            name: state
            for name, state in states.items()
            if state is not None and state.done_in(root, self.graph.plan)
        }

    def _note_tiles(self, part: Part) -> None:
        state = read_state(self.folder.root, part.name)
        if state is None or not state.done_in(self.folder.root, self.graph.plan):
            return
        known = planned_tiles(self.folder, state)
        if known is None:
            self._tiles.pop(part.region, None)
        else:
            self._tiles[part.region] = known

    def _start_ready(self) -> None:
        """Start what is ready, as far as engines have room; what was finished earlier is done."""
        for part in self.graph.parts:  # in an order in which they can be done
            if not self._is_ready(part):
                continue
            if part.name in self._earlier and part.kind not in CHECKED_AGAIN:
                self._done.add(part.name)
                continue
            engine = self._engine_of(part)
            taken = sum(self._engine_of(other) is engine for other in self._running.values())
            if taken >= engine.slots:
                continue
            attempt = self._attempts.get(part.name, 0) + 1
            self._attempts[part.name] = attempt
            self._running[part.name] = part
            engine.start(part, self.graph.plan, attempt)

    def _is_ready(self, part: Part) -> bool:
        begun = part.name in self._running or part.name in self._failed
        return not begun and part.name not in self._done and set(part.needs) <= self._done

    def _engine_of(self, part: Part) -> Engine:
        return self.here if part.kind in HERE else self.engine

    def _take(self, outcome: Outcome) -> None:
        part = outcome.part
        self._running.pop(part.name, None)
        if outcome.begun_again:
            self._begin_again(part.region)
            return
        if outcome.code == EXIT_DONE:
            self._done.add(part.name)
            if part.kind in CHECKED_AGAIN and self._has_changed(part):
                self._earlier = {}
                keep_states(self.folder.root, self._done)
            if part.kind == "plan":
                self._note_tiles(part)
                self._plan()
            if outcome.reused:
                self.report(self._fraction(), {}, len(self._done))
            return
        if outcome.code == EXIT_CANCELLED and self.is_cancelled():
            raise Cancelled()
        attempt = self._attempts[part.name]
        may_work = outcome.code in (MAY_WORK_ELSEWHERE, OTHER_CODE) or outcome.code < 0
        _logger.warning(
            "part %s ended with code %d (attempt %d): %s", part.name, outcome.code, attempt,
            outcome.error,
        )  # fmt: skip
        if not may_work or attempt >= MOST_ATTEMPTS:
            self._failed[part.name] = outcome

    def _has_changed(self, part: Part) -> bool:
        """Return whether a part that was asked again has made something else than before."""
        state, earlier = read_state(self.folder.root, part.name), self._earlier.get(part.name)
        return state is None or earlier is None or state.outputs != earlier.outputs

    def _begin_again(self, region: str) -> None:
        """Forget the parts of a region, and plan it anew."""
        for part in self.graph.of_region(region):
            self._done.discard(part.name)
            self._attempts.pop(part.name, None)
            state_path(self.folder.root, part.name).unlink(missing_ok=True)
        self._tiles.pop(region, None)
        self._tiles |= {k: v for k, v in fixed_tiles(self.job).items() if k == region}
        self._plan()

    def _fraction(self) -> float:
        total = sum(part.share for part in self.graph.parts)
        done = sum(part.share for part in self.graph.parts if part.name in self._done)
        return done / total
