# SPDX-License-Identifier: GPL-3.0-or-later
"""Examine the worker's Python without blocking Blender: a thread waits, a timer shows."""

from __future__ import annotations

import queue
import threading
from pathlib import Path

import bpy

from ..core.jobs.doctor import Diagnosis, find_and_diagnose
from .redrawing import redraw

POLL_S = 0.3

_answers: queue.Queue[list[Diagnosis]] = queue.Queue()
_findings: list[Diagnosis] = []
_busy = threading.Event()


def findings() -> tuple[Diagnosis, ...]:
    """Return what the last check has found."""
    return tuple(_findings)


def is_busy() -> bool:
    """Tell whether a check runs."""
    return _busy.is_set()


def as_text() -> str:
    """Return the findings for a bug report, with the home folder masked."""
    lines = [
        f"good {f.subject}: {f.finding}" if f.good else f"BAD  {f.subject}: {f.finding} {f.hint}"
        for f in _findings
    ]
    return "\n".join(lines).replace(str(Path.home()), "~")


def start(preference: str) -> None:
    """Begin a check of the interpreter that jobs would use."""
    _busy.set()
    _findings.clear()
    threading.Thread(target=_examine, args=(preference,), daemon=True).start()
    if not bpy.app.timers.is_registered(show):
        bpy.app.timers.register(show, first_interval=POLL_S, persistent=True)


def _examine(preference: str) -> None:
    """Thread: touches nothing of Blender."""
    try:
        found = find_and_diagnose(preference)
    except Exception as error:  # the queue must get an answer, or the check would never end
        found = [Diagnosis("Python", False, f"{type(error).__name__}: {error}", "")]
    _answers.put(found)


def show() -> float | None:
    """Timer: take the answer when there is one, and redraw."""
    try:
        found = _answers.get_nowait()
    except queue.Empty:
        return POLL_S
    _findings[:] = found
    _busy.clear()
    redraw("PREFERENCES")
    return None


def stop() -> None:
    """Take the timer out."""
    if bpy.app.timers.is_registered(show):
        bpy.app.timers.unregister(show)
    _busy.clear()
