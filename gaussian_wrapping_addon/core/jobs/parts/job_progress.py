# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a job is: the progress of its parts, run here or elsewhere, on one scale."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path

from ...progress import Progress, ProgressEvent
from .graph import Part
from .part_state import read_state

STATES_EVERY_S = 1.0
"""How often the states of parts that run elsewhere are read."""
STAGE_OF_KIND = {
    "coarse": "train", "block": "train", "plan": "mesh", "points": "mesh", "gather": "mesh",
    "faces": "mesh",
}  # fmt: skip
"""Stage that people are shown, of parts that are no stage by themselves."""


class JobProgress:
    """Map the progress of each part onto the whole job and estimate the time left."""

    def __init__(
        self, sink: Callable[[ProgressEvent], None], is_cancelled: Callable[[], bool]
    ) -> None:
        self._sink = sink
        self._is_cancelled = is_cancelled
        self._begun_s = time.monotonic()
        self._offset = 0.0
        self._done = 0.0
        self._total = 1.0
        self._read_s = 0.0

    def part(self, part: Part) -> Progress:
        """Return the progress of a part that this process runs."""
        begin, width = self._done, part.share / self._total

        def forward(event: ProgressEvent) -> None:
            self._send(event, begin + width * event.fraction)

        return Progress(stage_of(part), forward, self._is_cancelled)

    def begin(self, total: float) -> None:
        """Take the sum of all shares."""
        self._total = total

    def report(self, done: float, running: Mapping[str, Part], count: int) -> None:
        """Take the share of the job that is done; without running parts it took no time."""
        self._done = done
        if not running:
            self._begun_s = time.monotonic()
            self._offset = done

    def side_by_side(self, root: Path) -> Callable[[float, Mapping[str, Part], int], None]:
        """Return :meth:`report` for parts whose states tell how far they are."""

        def report(done: float, running: Mapping[str, Part], count: int) -> None:
            self.report(done, running, count)
            if running and time.monotonic() - self._read_s > STATES_EVERY_S:
                self._read_s = time.monotonic()
                states = {name: read_state(root, name) for name in running}
                begun = {n: s for n, s in states.items() if s is not None and s.state == "RUNNING"}
                under_way = sum(running[n].share * s.fraction for n, s in begun.items())
                first = next(iter(begun or running))
                said = begun[first].message if first in begun else "waits for a computer"
                also = f" and {len(running) - 1} more" if len(running) > 1 else ""
                message = f"{first}: {said}{also}; parts done: {count}"
                figures = begun[first].figures if first in begun else {}
                event = ProgressEvent(stage_of(running[first]), 0.0, message, figures)
                self._send(event, done + under_way / self._total)

        return report

    def _send(self, event: ProgressEvent, overall: float) -> None:
        elapsed_s = time.monotonic() - self._begun_s
        gained = overall - self._offset
        left_s = elapsed_s * (1.0 - overall) / gained if gained > 0.01 else None
        self._sink(
            ProgressEvent(event.stage, overall, event.message, event.figures, left_s, event.phase)
        )


def stage_of(part: Part) -> str:
    """Return the stage of a job that people are shown for a part."""
    return STAGE_OF_KIND.get(part.kind, part.kind)
