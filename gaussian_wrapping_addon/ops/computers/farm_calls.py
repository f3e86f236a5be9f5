# SPDX-License-Identifier: GPL-3.0-or-later
"""Requests to a farm in a thread, one at a time, and their outcome for the panel."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from ...core.errors import WrapError
from ..common.background import Lane
from ..common.redrawing import redraw_sidebars

_logger = logging.getLogger(__name__)

Result = TypeVar("Result")


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


def call(
    about: str,
    request: Callable[[], Result],
    then: Callable[[Result], tuple[str, ...] | Outcome],
    end: Callable[[], None] | None = None,
) -> None:
    """Run a request in the thread.

    Parameters
    ----------
    about : str
        The address or folder that it is about.
    request : callable
        Runs in the thread; touches nothing of Blender.
    then : callable
        Receives the result on the main thread; returns sentences on it, or an outcome.
    end : callable, optional
        Ends what the request waits for, where nobody waits for it any more.
    """
    _lane.cancel()
    _memory.outcome, _memory.about = None, about

    def keep(result: Result) -> None:
        found = then(result)
        _end(found if isinstance(found, Outcome) else Outcome(True, found))

    def keep_failure(error: Exception) -> None:
        if not isinstance(error, WrapError | OSError):
            _logger.error("a request to a farm", exc_info=error)
        lines = (error.message, error.hint) if isinstance(error, WrapError) else (str(error),)
        _end(Outcome(False, tuple(filter(None, lines))))

    _lane.submit(request, keep, failed=keep_failure, end=end)


def stop() -> None:
    """Forget everything; a request that runs ends by itself within seconds."""
    _lane.stop()
    _memory.outcome = None


def _end(outcome: Outcome) -> None:
    _memory.outcome = outcome
    redraw_sidebars()
