# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress reports with remaining time, and cooperative cancellation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from .errors import Cancelled

COMPILING = "compiling"
"""Phase in which kernels are compiled: no Python code runs that could poll for cancellation, and
nothing is lost if the process ends at once."""


@dataclass(frozen=True)
class ProgressEvent:
    """One progress report: fraction in [0, 1] of the stage, a short message, optional figures."""

    stage: str
    fraction: float
    message: str
    figures: dict[str, float] = field(default_factory=dict)
    seconds_left: float | None = None
    phase: str = ""
    """Phase for programs, such as :data:`COMPILING`."""


class Progress:
    """Progress of a span of one stage; :meth:`span` returns a sub-span for a callee.

    Parameters
    ----------
    stage : str
        Name of the stage, such as ``"train"``.
    sink : callable or None
        Receives a :class:`ProgressEvent`; ``None`` drops them.
    is_cancelled : callable or None
        Polled by :meth:`check`, which raises :class:`Cancelled` if it returns true.
    """

    def __init__(
        self,
        stage: str = "",
        sink: Callable[[ProgressEvent], None] | None = None,
        is_cancelled: Callable[[], bool] | None = None,
        *,
        start: float = 0.0,
        end: float = 1.0,
        begun_s: float | None = None,
    ) -> None:
        self.stage = stage
        self._sink = sink
        self._is_cancelled = is_cancelled
        self._start = start
        self._end = end
        self._begun_s = time.monotonic() if begun_s is None else begun_s

    def span(self, start: float, end: float) -> Progress:
        """Return the part [start, end] of this span, for a callee."""
        width = self._end - self._start
        return Progress(
            self.stage,
            self._sink,
            self._is_cancelled,
            start=self._start + width * start,
            end=self._start + width * end,
            begun_s=self._begun_s,
        )

    def cancelled(self) -> bool:
        """Return whether the user cancelled, without raising."""
        return self._is_cancelled is not None and self._is_cancelled()

    def check(self) -> None:
        """Raise :class:`Cancelled` if the user cancelled."""
        if self.cancelled():
            raise Cancelled()

    def update(self, fraction: float, message: str = "", **figures: float) -> None:
        """Report ``fraction`` of this span as done, then check for cancellation."""
        self._report(fraction, message, figures)

    def enter(self, phase: str, message: str) -> None:
        """Report the start of a phase, lasting until the next report; check for cancellation."""
        self._report(0.0, message, {}, phase)

    def _report(
        self, fraction: float, message: str, figures: dict[str, float], phase: str = ""
    ) -> None:
        if self._sink is not None:
            local = min(max(fraction, 0.0), 1.0)
            overall = self._start + (self._end - self._start) * local
            elapsed_s = time.monotonic() - self._begun_s
            left_s = elapsed_s * (1.0 - overall) / overall if overall > 0.01 else None
            self._sink(ProgressEvent(self.stage, overall, message, dict(figures), left_s, phase))
        self.check()
