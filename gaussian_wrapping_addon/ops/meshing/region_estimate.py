# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimate the meshes of regions (triangles, time, memory) by the worker, in the background.

Regions are estimated one after the other. An estimate stays until its region is estimated again;
:func:`answer_for` returns whether its inputs have changed since.
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.files import write_json
from ...core.jobs.client import worker_python
from ...core.processes.helper_process import child_command
from ...core.settings import MeshingSettings, to_json
from ..common import tags
from ..common.background import Lane, Task
from ..common.estimate_child import Child
from ..common.redrawing import redraw
from ..jobs.panel_settings import method_choices
from ..regions import region_watch
from ..regions.region_objects import region_body
from ..regions.region_resolution import (
    checked_edge_length,
    edge_length_in_blender,
    world_per_blender,
)
from ..training.training_estimate import Estimate, estimate_of, estimate_of_failure

MODULE = "jobs.commands.estimate_mesh_command"
DEADLINE_S = 600.0

# Relative: difference of the float32 matrices of an object that has not moved.
_SAME = 1e-5


@dataclass(frozen=True)
class Asked:
    """Inputs of an estimate."""

    relative: np.ndarray
    """(4, 4) matrix of the region in its frame."""
    rest: tuple[object, ...]

    def is_as(self, other: Asked) -> bool:
        """Return whether both give the same estimate."""
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


@dataclass(frozen=True)
class _Asking:
    child: Child
    task: Task[Estimate]


@dataclass
class _State:
    asking: dict[int, _Asking] = field(default_factory=dict)
    """By the region's session id."""
    asked: dict[int, Asked] = field(default_factory=dict)
    answers: dict[int, Estimate] = field(default_factory=dict)


_questions = Lane(of_file=True)
_state = _State()


def is_busy() -> bool:
    """Return whether estimates are running."""
    return _questions.busy


def is_waiting(region: bpy.types.Object) -> bool:
    """Return whether a region's estimate is running."""
    asking = _state.asking.get(region.session_uid)
    return asking is not None and asking.task.pending


def answer_for(scene: bpy.types.Scene, region: bpy.types.Object) -> tuple[Estimate | None, bool]:
    """Return a region's estimate, if there is one, and whether it is up to date."""
    answer = _state.answers.get(region.session_uid)
    if answer is None:
        return None, False
    return answer, _state.asked[region.session_uid].is_as(asked_of(scene, region))


def asked_of(scene: bpy.types.Scene, region: bpy.types.Object) -> Asked:
    """Return the current inputs of a region's estimate; cheap, for panels."""
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
        From the preferences.

    Raises
    ------
    WrapError
        A region, its resolution or the interpreter cannot be used; no estimate is started.
    """
    interpreter = worker_python(python)
    questions = [_question(scene, region, folder, interpreter) for region in regions]
    stop_asking()
    for region in regions:
        _state.asked[region.session_uid] = asked_of(scene, region)
        _state.answers.pop(region.session_uid, None)
    for question in questions:
        child = Child()
        task = _questions.submit(
            partial(_ask, child, question),
            partial(_keep, question.uid),
            failed=partial(_keep_failure, question.uid),
            end=child.end,
        )
        _state.asking[question.uid] = _Asking(child, task)


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


def _ask(child: Child, question: _Question) -> Estimate:
    """Run one estimate; in a thread."""
    with tempfile.TemporaryDirectory(prefix="gwrap-") as folder:
        path = os.path.join(folder, "region.json")
        write_json(Path(path), question.body)
        request = json.dumps({**question.request, "region": path}, allow_nan=False)
        command = child_command(MODULE, request, python=question.python)
        return estimate_of(*child.ask(command, DEADLINE_S))


def _keep(uid: int, answer: Estimate) -> None:
    _state.answers[uid] = answer
    _state.asking.pop(uid, None)
    redraw()


def _keep_failure(uid: int, error: Exception) -> None:
    _keep(uid, estimate_of_failure(error))


def stop_asking() -> None:
    """Cancel running estimates; finished ones stay."""
    _questions.cancel()
    _state.asking.clear()


def stop() -> None:
    """Cancel and forget all estimates."""
    stop_asking()
    _state.asked.clear()
    _state.answers.clear()
