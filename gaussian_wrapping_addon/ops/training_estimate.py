# SPDX-License-Identifier: GPL-3.0-or-later
"""Ask a child process what a training will need; a thread waits, a timer shows the answer."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
from dataclasses import dataclass
from typing import Any

import bpy

from ..core.errors import WorkerError, WrapError
from ..core.evaluation.report.text import NOT_MEASURED, bytes_text, duration, measured
from ..core.helper_process import child_command, child_environment, kill_group
from ..core.jobs.client import worker_python
from ..core.settings import to_json
from .job_actions import WorkerChoice, source_of
from .training_choices import choices_key, job_settings

MODULE = "jobs.estimate"
DEADLINE_S = 300.0
POLL_S = 0.3


@dataclass(frozen=True)
class Estimate:
    """One answer, ready to draw."""

    text: str
    good: bool = True
    hint: str = ""


@dataclass
class _Question:
    number: int = 0
    key: tuple[object, ...] = ()
    answer: Estimate | None = None
    process: subprocess.Popen[bytes] | None = None


_question = _Question()
_answers: queue.Queue[tuple[int, Estimate]] = queue.Queue()
_guard = threading.Lock()


def is_busy() -> bool:
    """Tell whether an answer is awaited."""
    return _question.number > 0 and _question.answer is None


def answer_for(scene: bpy.types.Scene) -> Estimate | None:
    """Return the estimate for what a scene's panels ask for now; None after a change."""
    return _question.answer if _question.key == choices_key(scene) else None


def start(scene: bpy.types.Scene, choice: WorkerChoice) -> None:
    """Begin an estimate for a scene's photos and choices.

    Raises
    ------
    WrapError
        The source, a choice or the interpreter cannot be used.
    """
    settings = job_settings(scene, choice.threads).validated()
    request = {"source": str(source_of(scene)), "settings": to_json(settings)}
    command = child_command(
        MODULE, json.dumps(request, allow_nan=False), python=worker_python(choice.python)
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
        answer = estimate_of(_run(number, command))
    except WrapError as error:
        answer = Estimate(error.message, False, error.hint)
    except Exception as error:  # the queue must get an answer, or the wait would never end
        answer = Estimate(f"{type(error).__name__}: {error}", False)
    _answers.put((number, answer))


def _run(number: int, command: list[str]) -> dict[str, Any]:
    """Return the last JSON object that the child writes."""
    options: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        options = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=child_environment(),
            **options,
        )
    except OSError as error:
        raise WorkerError(
            f"{command[0]} does not run: {error}.", "Choose another Python."
        ) from None
    with _guard:
        wanted = _question.number == number
        _question.process = process if wanted else _question.process
    if not wanted:
        kill_group(process)
    try:
        output, words = process.communicate(timeout=DEADLINE_S)
    except subprocess.TimeoutExpired:
        kill_group(process)
        raise WorkerError("The estimate took too long.", "Start the job without it.") from None
    found: dict[str, Any] = {}
    for line in output.decode(errors="replace").splitlines():
        try:
            values = json.loads(line)
        except ValueError:
            continue
        found = values if isinstance(values, dict) else found
    if not found:
        last = words.decode(errors="replace").strip().splitlines()
        raise WorkerError(
            f"There is no estimate: {last[-1] if last else 'the worker said nothing'}.",
            "Check the worker in the add-on's preferences.",
        )
    return found


def estimate_of(values: dict[str, Any]) -> Estimate:
    """Turn the child's figures into a line, such as ``About 4-6 min, 1.2 GiB memory``.

    Parameters
    ----------
    values : dict
        ``seconds_low``, ``seconds_high``, ``memory_bytes``, ``disk_bytes``, ``warnings`` (texts);
        or ``error`` and ``hint``.
    """
    if values.get("error"):
        return Estimate(str(values["error"]), False, str(values.get("hint", "")))
    parts = [_span(measured(values.get("seconds_low")), measured(values.get("seconds_high")))]
    for name, word in (("memory_bytes", "memory"), ("disk_bytes", "disk")):
        text = bytes_text(values.get(name))
        parts.append("" if text == NOT_MEASURED else f"{text} {word}")
    text = ", ".join(part for part in parts if part)
    if not text:
        return Estimate("The worker's estimate holds no figures.", False, "Update the worker.")
    warnings = values.get("warnings")
    hint = " ".join(str(w) for w in warnings) if isinstance(warnings, list) else ""
    return Estimate(f"About {text}", not hint, hint)


def _span(low_s: float | None, high_s: float | None) -> str:
    if low_s is None or high_s is None:
        either = high_s if low_s is None else low_s
        return "" if either is None else duration(either)
    if high_s < 90:
        low, high, unit = round(low_s), round(high_s), "s"
    elif high_s < 90 * 60:
        low, high, unit = round(low_s / 60), round(high_s / 60), "min"
    else:
        return f"{duration(low_s)} to {duration(high_s)}"
    return f"{high} {unit}" if low == high else f"{low}-{high} {unit}"


def show() -> float | None:
    """Timer: take the answer when there is one, and redraw."""
    while True:
        try:
            number, answer = _answers.get_nowait()
        except queue.Empty:
            break
        if number == _question.number:
            _question.answer, _question.process = answer, None
    if is_busy():
        return POLL_S
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
    return None


def stop() -> None:
    """Forget the question and end its process."""
    with _guard:
        process, _question.process = _question.process, None
        _question.number += 1
        _question.key, _question.answer = (), Estimate("", False)
    if process is not None and process.poll() is None:
        threading.Thread(target=kill_group, args=(process,), daemon=True).start()
    if bpy.app.timers.is_registered(show):
        bpy.app.timers.unregister(show)
