# SPDX-License-Identifier: GPL-3.0-or-later
"""Ask a child process what a training will need; a thread waits, a timer shows the answer."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
from dataclasses import dataclass
from typing import Any

import bpy

from ..core.errors import WorkerError, WrapError
from ..core.helper_process import child_command
from ..core.jobs.client import worker_python
from ..core.jobs.job_file import make_job
from ..core.processes.spawn import kill_group
from .estimate_child import ask_child
from .job_actions import WorkerChoice, source_of
from .redrawing import answers_in, redraw
from .training_choices import choices_key, job_settings

MODULE = "jobs.estimate"
DEADLINE_S = 300.0
POLL_S = 0.3
MAX_LINES = 20
MAX_TEXT = 300
MAX_KNOWN = 20
"""Answers kept, so that going back to a preset shows its estimate again."""
_WARNING = "warning: "


@dataclass(frozen=True)
class Estimate:
    """One answer, ready to draw."""

    lines: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """What stands in the way, or may."""


@dataclass
class _Question:
    number: int = 0
    key: tuple[object, ...] = ()
    answer: Estimate | None = None
    process: subprocess.Popen[bytes] | None = None


_question = _Question()
_known: dict[tuple[object, ...], Estimate] = {}
_answers: queue.Queue[tuple[int, Estimate]] = queue.Queue()
_guard = threading.Lock()


def is_busy() -> bool:
    """Tell whether an answer is awaited."""
    return _question.number > 0 and _question.answer is None


def answer_for(scene: bpy.types.Scene) -> Estimate | None:
    """Return the estimate for what a scene's panels ask for now; None where it is not known."""
    return _known.get(choices_key(scene))


def answer_with(scene: bpy.types.Scene, error: WrapError) -> None:
    """Show in place of an estimate why there is none."""
    _keep(choices_key(scene), Estimate((), (error.message, error.hint)))


def _keep(key: tuple[object, ...], answer: Estimate) -> None:
    _known.pop(key, None)
    _known[key] = answer
    while len(_known) > MAX_KNOWN:
        del _known[next(iter(_known))]


def forget() -> None:
    """Forget all answers: the photos may be others under the same names."""
    stop()
    _known.clear()


def start(scene: bpy.types.Scene, choice: WorkerChoice) -> None:
    """Begin an estimate for a scene's photos and choices.

    Raises
    ------
    WrapError
        The source, a choice or the interpreter cannot be used.
    """
    job = make_job("wrap", source_of(scene), job_settings(scene, choice.threads))
    command = child_command(
        MODULE, json.dumps(job.to_json(), allow_nan=False), python=worker_python(choice.python)
    )
    stop()
    number = _question.number
    _question.key, _question.answer = choices_key(scene), None
    threading.Thread(target=_ask, args=(number, command), daemon=True).start()
    if not bpy.app.timers.is_registered(show):
        bpy.app.timers.register(show, first_interval=POLL_S, persistent=True)


def _ask(number: int, command: list[str]) -> None:
    """Thread: touches nothing of Blender."""
    try:
        answer = _run(number, command)
    except WrapError as error:
        answer = Estimate((), (error.message, error.hint))
    except Exception as error:  # the queue must get an answer, or the wait would never end
        answer = Estimate((), (f"{type(error).__name__}: {error}",))
    _answers.put((number, answer))


def _run(number: int, command: list[str]) -> Estimate:
    """Start the child and return what it says."""

    def begun(process: subprocess.Popen[bytes]) -> bool:
        with _guard:
            wanted = _question.number == number
            _question.process = process if wanted else _question.process
        return wanted

    return estimate_of(*ask_child(command, begun, DEADLINE_S))


def estimate_of(said: list[dict[str, Any]], last_words: str = "") -> Estimate:
    """Turn what the child said into lines for the panel.

    Parameters
    ----------
    said : list of dict
        ``{"line": text}`` for each line, of which some begin with ``warning:``, or
        ``{"error": text, "hint": text}``.
    last_words : str
        The end of what the child wrote to its terminal, in case it said nothing else.

    Raises
    ------
    WorkerError
        It said nothing.
    """
    for values in said:
        if values.get("error"):
            return Estimate((), (str(values["error"]), str(values.get("hint", ""))))
    lines = [str(values["line"])[:MAX_TEXT] for values in said if values.get("line")][:MAX_LINES]
    if not lines:
        raise WorkerError(
            f"There is no estimate: {last_words or 'the worker said nothing'}.",
            "Check the worker in the add-on's preferences.",
        )
    warnings = tuple(line.removeprefix(_WARNING) for line in lines if line.startswith(_WARNING))
    plain = tuple(_capital(line) for line in lines if not line.startswith(_WARNING))
    return Estimate(plain, tuple(_capital(text) for text in warnings))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def show() -> float | None:
    """Timer: take the answer when there is one, and redraw."""
    for number, answer in answers_in(_answers):
        if number == _question.number:
            _question.answer, _question.process = answer, None
            _keep(_question.key, answer)
    if is_busy():
        return POLL_S
    redraw()
    return None


def stop() -> None:
    """Forget the question and end its process."""
    with _guard:
        process, _question.process = _question.process, None
        _question.number += 1
        _question.key, _question.answer = (), Estimate()
    if process is not None and process.poll() is None:
        threading.Thread(target=kill_group, args=(process,), daemon=True).start()
    if bpy.app.timers.is_registered(show):
        bpy.app.timers.unregister(show)
