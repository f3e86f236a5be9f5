# SPDX-License-Identifier: GPL-3.0-or-later
"""Ask the worker what the meshes of regions will take; a thread waits, a timer shows the answers.

Regions are asked about one after the other. An answer stays until its region is asked about again;
:func:`answer_for` tells whether what it was about has changed since.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import tempfile
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.errors import WrapError
from ..core.files import write_json
from ..core.helper_process import child_command
from ..core.jobs.client import worker_python
from ..core.processes.spawn import kill_group
from ..core.settings import MeshingSettings, to_json
from . import region_watch, tags
from .estimate_child import ask_child
from .redrawing import answers_in, redraw
from .region_objects import region_body
from .region_resolution import checked_edge_length, edge_length_in_blender, world_per_blender
from .training_choices import method_choices
from .training_estimate import Estimate, estimate_of

MODULE = "jobs.mesh_estimate"
DEADLINE_S = 600.0
POLL_S = 0.3

# Relative: what float32 matrices of an object that nobody moved may differ by.
_SAME = 1e-5


@dataclass(frozen=True)
class Asked:
    """What an estimate is about."""

    relative: np.ndarray
    """(4, 4) matrix of the region in its frame."""
    rest: tuple[object, ...]

    def is_as(self, other: Asked) -> bool:
        """Tell whether an answer to one is an answer to the other."""
        scale = float(np.abs(self.relative[:3]).max())
        same = np.allclose(self.relative, other.relative, rtol=0.0, atol=_SAME * scale)
        return self.rest == other.rest and bool(same)


@dataclass(frozen=True)
class _Question:
    uid: int
    body: dict[str, Any]
    """The region file's content."""
    request: dict[str, Any]
    python: str


@dataclass
class _State:
    number: int = 0
    waiting: list[int] = field(default_factory=list)
    """Session ids of the regions that have no answer yet."""
    asked: dict[int, Asked] = field(default_factory=dict)
    answers: dict[int, Estimate] = field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None


_state = _State()
_answers: queue.Queue[tuple[int, int, Estimate]] = queue.Queue()
_guard = threading.Lock()


def is_busy() -> bool:
    """Tell whether answers are awaited."""
    return bool(_state.waiting)


def is_waiting(region: bpy.types.Object) -> bool:
    """Tell whether a region's answer is awaited."""
    return region.session_uid in _state.waiting


def answer_for(scene: bpy.types.Scene, region: bpy.types.Object) -> tuple[Estimate | None, bool]:
    """Return a region's estimate, if there is one, and whether it still holds."""
    answer = _state.answers.get(region.session_uid)
    if answer is None:
        return None, False
    return answer, _state.asked[region.session_uid].is_as(asked_of(scene, region))


def asked_of(scene: bpy.types.Scene, region: bpy.types.Object) -> Asked:
    """Return what an estimate for a region would be about now; cheap, for panels."""
    frame = tags.frame_of(region)
    matrix = np.array(region.matrix_world, np.float64)
    scale, folder = 1.0, ""
    if frame is not None:
        of_frame = np.array(frame.matrix_world, np.float64)
        scale = abs(float(np.linalg.det(of_frame[:3, :3]))) ** (1.0 / 3.0)
        folder = str(frame.get(tags.RESULT, ""))
        if scale > 0.0:
            matrix = np.linalg.solve(of_frame, matrix)
    length = edge_length_in_blender(scene, region) / (scale or 1.0)
    choices = method_choices(scene) | {"edge_length": f"{length:.5g}"}
    if length:
        choices["points"] = 0
    shape = region_watch.shape_key(region)
    return Asked(matrix, (folder, *choices.values(), *shape))


def start(
    scene: bpy.types.Scene, regions: list[bpy.types.Object], folder: Path, python: str
) -> None:
    """Begin estimates for regions of one result; those of other regions stay.

    Parameters
    ----------
    folder : Path
        The job folder of the finished training.
    python : str
        As the preferences say.

    Raises
    ------
    WrapError
        A region, its resolution or the interpreter cannot be used; nothing is asked then.
    """
    interpreter = worker_python(python)
    questions = [_question(scene, region, folder, interpreter) for region in regions]
    stop_asking()
    for region in regions:
        _state.asked[region.session_uid] = asked_of(scene, region)
        _state.answers.pop(region.session_uid, None)
    _state.waiting = [question.uid for question in questions]
    threading.Thread(target=_ask_all, args=(_state.number, questions), daemon=True).start()
    if not bpy.app.timers.is_registered(show):
        bpy.app.timers.register(show, first_interval=POLL_S, persistent=True)


def _question(
    scene: bpy.types.Scene, region: bpy.types.Object, folder: Path, python: str
) -> _Question:
    frame = tags.frame_of(region)
    assert frame is not None  # whoever starts has found the job folder by it
    length = checked_edge_length(scene, region) * world_per_blender(frame)
    values = {**method_choices(scene), "edge_length": length}
    if length:
        values["points"] = 0
    meshing = MeshingSettings(**values)
    request = {"out": str(folder), "meshing": to_json(meshing), "threads": 0}
    return _Question(region.session_uid, region_body(region), request, python)


def _ask_all(number: int, questions: list[_Question]) -> None:
    """Thread: touches nothing of Blender."""
    for question in questions:
        try:
            answer = _ask(number, question)
        except WrapError as error:
            answer = Estimate((), (error.message, error.hint))
        except Exception as error:  # the queue must get an answer, or the wait would never end
            answer = Estimate((), (f"{type(error).__name__}: {error}",))
        if _state.number != number:
            return
        _answers.put((number, question.uid, answer))


def _ask(number: int, question: _Question) -> Estimate:
    def begun(process: subprocess.Popen[bytes]) -> bool:
        with _guard:
            wanted = _state.number == number
            _state.process = process if wanted else _state.process
        return wanted

    with tempfile.TemporaryDirectory(prefix="gwrap-") as folder:
        path = os.path.join(folder, "region.json")
        write_json(Path(path), question.body)
        request = json.dumps({**question.request, "region": path}, allow_nan=False)
        command = child_command(MODULE, request, python=question.python)
        return estimate_of(*ask_child(command, begun, DEADLINE_S))


def show() -> float | None:
    """Timer: take the answers that are there, and redraw."""
    news = False
    for number, uid, answer in answers_in(_answers):
        if number == _state.number and uid in _state.waiting:
            _state.answers[uid] = answer
            _state.waiting.remove(uid)
            news = True
    if news:
        redraw()
    return POLL_S if is_busy() else None


def stop_asking() -> None:
    """End what is being asked; answers stay."""
    with _guard:
        process, _state.process = _state.process, None
        _state.number += 1
        _state.waiting = []
    if process is not None and process.poll() is None:
        threading.Thread(target=kill_group, args=(process,), daemon=True).start()


def stop() -> None:
    """Forget all questions and answers."""
    stop_asking()
    _state.asked.clear()
    _state.answers.clear()
    if bpy.app.timers.is_registered(show):
        bpy.app.timers.unregister(show)
