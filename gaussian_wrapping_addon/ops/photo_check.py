# SPDX-License-Identifier: GPL-3.0-or-later
"""Check an input without blocking Blender: a thread looks, a timer keeps what it found."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ..core.errors import WrapError
from . import panel_state, training_estimate
from .job_actions import WorkerChoice, source_of
from .redrawing import answers_in, redraw

if TYPE_CHECKING:
    from ..core.dataset.check import Finding

_logger = logging.getLogger(__name__)

POLL_S = 0.2


@dataclass
class _Check:
    number: int = 0
    scene_uid: int = 0
    source: str = ""
    choice: WorkerChoice | None = None
    busy: bool = False


_check = _Check()
_answers: queue.Queue[tuple[int, list[Finding]]] = queue.Queue()


def is_busy() -> bool:
    """Tell whether a check is under way."""
    return _check.busy


def check_now(scene: bpy.types.Scene) -> None:
    """Check a scene's input and keep the findings; Blender waits.

    Raises
    ------
    UsageError
        No input is chosen.
    """
    from ..core.dataset.check import check_input

    stop()
    _keep(scene, check_input(source_of(scene)))


def start(scene: bpy.types.Scene, choice: WorkerChoice | None = None) -> None:
    """Begin to check a scene's input.

    Parameters
    ----------
    choice : WorkerChoice, optional
        Ask this worker for an estimate of the training as well, where there are no errors.

    Raises
    ------
    UsageError
        No input is chosen.
    """
    from ..core.dataset.check import check_input  # imported here: threads import nothing

    source = source_of(scene)
    stop()
    _check.scene_uid, _check.source = scene.session_uid, scene.gwrap.source
    _check.choice, _check.busy = choice, True
    arguments = (_check.number, check_input, source)
    threading.Thread(target=_look, args=arguments, daemon=True).start()
    if not bpy.app.timers.is_registered(show):
        bpy.app.timers.register(show, first_interval=POLL_S, persistent=True)


def _look(number: int, check_input: Callable[[Path], list[Finding]], source: Path) -> None:
    """Thread: touches nothing of Blender."""
    from ..core.dataset.check import Finding

    try:
        found = check_input(source)
    except Exception as error:  # the queue must get an answer, or the check would never end
        _logger.exception("checking %s", source)
        found = [Finding("error", f"{type(error).__name__}: {error}", "See the system console.")]
    _answers.put((number, found))


def show() -> float | None:
    """Timer: keep the findings when they are there, and redraw."""
    for number, found in answers_in(_answers):
        if number != _check.number:
            continue  # of a check that a later one has replaced
        _check.busy = False
        scene = next((s for s in bpy.data.scenes if s.session_uid == _check.scene_uid), None)
        if scene is not None and scene.gwrap.source == _check.source:
            _keep(scene, found)
            _estimate(scene)
    if _check.busy:
        return POLL_S
    redraw()
    return None


def _keep(scene: bpy.types.Scene, found: list[Finding]) -> None:
    properties = scene.gwrap
    properties.findings.clear()
    properties.checked_source = properties.source
    properties.checked_text = ", ".join(f.short for f in found if f.short)
    for finding in found:
        row = properties.findings.add()
        row.severity = finding.severity
        row.message = finding.message
        row.hint = finding.hint


def _estimate(scene: bpy.types.Scene) -> None:
    if _check.choice is None or panel_state.has_errors(scene):
        return
    try:
        training_estimate.start(scene, _check.choice)
    except WrapError as error:
        training_estimate.answer_with(scene, error)


def stop() -> None:
    """Forget a check that is under way; its thread ends by itself."""
    _check.number += 1
    _check.busy = False
    if bpy.app.timers.is_registered(show):
        bpy.app.timers.unregister(show)
