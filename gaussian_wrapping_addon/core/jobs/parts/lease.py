# SPDX-License-Identifier: GPL-3.0-or-later
"""Hold a part of a job while this process runs it, and show others that it lives.

A part is held by its state file, which names the process and is written again every few seconds.
Who finds it held by a process that has ended, or that has shown nothing for long, takes it over; a
process that comes back, as after a cut network, finds another one's name and stops. Where two ran
the same part for a while, that only cost time: files are written whole, and are the same.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ... import limits
from ...errors import Cancelled, WorkerError
from ...files import seconds_since_written
from ...progress import ProgressEvent
from ...worker.helper_process import emit, own_peak_bytes
from ...worker.spawn import is_here, owner_alive
from . import graph

_logger = logging.getLogger(__name__)

BEAT_S = 5.0
WAIT_S = 1.0


class PartHeldError(WorkerError):
    """Another process runs the part."""


class PartLease:
    """The lease of this process on one part.

    ``root``: the job folder; ``name``, ``plan``: the part, and the plan that it is run for.
    """

    def __init__(self, root: Path, name: str, plan: str, attempt: int) -> None:
        self._root, self._name = root, name
        self._state = graph.new_state(plan, attempt)
        self._begun_s = time.monotonic()
        self._ended = threading.Event()
        self._guard = threading.Lock()
        self._thread = threading.Thread(target=self._beat, daemon=True)
        self._is_held = False
        self.is_lost = False
        """Whether another process has taken the part over."""

    def take(self, is_cancelled: Callable[[], bool] | None = None) -> bool:
        """Begin to hold the part; return false if another process has done it meanwhile.

        With ``is_cancelled``, wait until a process that runs the part has ended, or has done it.
        Raises PartHeldError: another process runs it; Cancelled: while waiting.
        """
        while (held := self._held()) is not None:
            if is_cancelled is None:
                raise PartHeldError(
                    f"Part {self._name} is run by process {held.pid} of {held.host}.",
                    "Wait for it, or end that process.",
                )
            if is_cancelled():
                raise Cancelled()
            time.sleep(WAIT_S)
        if graph.done_state(self._root, self._name, self._state.plan) is not None:
            return False
        self._write()
        self._is_held = True
        self._thread.start()
        return True

    def _held(self) -> graph.PartState | None:
        """Return the state of a living process that runs the part; ``None`` if there is none."""
        held = graph.read_state(self._root, self._name)
        return held if held and held.state == "RUNNING" and self._lives(held) else None

    def event(self, event: ProgressEvent) -> None:
        """Take the progress of the part; written with the next beat."""
        with self._guard:
            finite = {name: x for name, x in event.figures.items() if math.isfinite(x)}
            self._state = replace(
                self._state, fraction=event.fraction, message=event.message or self._state.message,
                figures={**self._state.figures, **finite},
            )  # fmt: skip

    def tell(self) -> None:
        """Write a line about the progress, if anybody reads the output."""
        with self._guard, contextlib.suppress(OSError):
            emit(message=self._state.message or self._name, fraction=round(self._state.fraction, 4))

    def finish(self, state: str, **changes: object) -> graph.PartState:
        """Write how the part has ended, unless another process holds it.

        Raises OSError: it cannot be written that the part is done; a failure need not be known.
        """
        if not self._is_held:
            return self._state
        self._ended.set()
        self._thread.join()
        with self._guard:
            self._state = replace(self._state, state=state, **changes)  # type: ignore[arg-type]
        if not self._is_taken():
            try:
                self._write()
            except OSError:
                if state == "DONE":
                    raise
                with contextlib.suppress(OSError):  # a full disk has the room of the earlier state
                    graph.overwrite_state(self._root, self._name, self._state)
        return self._state

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_S):
            if self._is_taken():
                _logger.warning("part %s was taken over by another process", self._name)
                self.is_lost = True
                return
            with contextlib.suppress(OSError):  # a full disk ends the part with its own error
                self._write()

    def _write(self) -> None:
        with self._guard:
            self._state = replace(
                self._state, seconds=round(time.monotonic() - self._begun_s, 3),
                heartbeat_s=round(time.time(), 1), peak_memory_bytes=own_peak_bytes(),
            )  # fmt: skip
            graph.write_state(self._root, self._name, self._state)

    def _is_taken(self) -> bool:
        now = graph.read_state(self._root, self._name)
        return now is not None and now.token != self._state.token

    def _lives(self, state: graph.PartState) -> bool:
        if is_here(state.place):
            return owner_alive(state.pid, state.pid_started)
        try:
            age_s = seconds_since_written(graph.state_path(self._root, self._name))
        except OSError:
            return False
        return age_s < limits.SILENT_S
