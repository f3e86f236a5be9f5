# SPDX-License-Identifier: GPL-3.0-or-later
"""Region list, mesh estimate."""

import json
import os
import tempfile
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import bpy
import numpy as np
from bpy.props import BoolProperty, StringProperty

from ..core.errors import UsageError
from ..core.files import write_json
from ..core.jobs.client import worker_python
from ..core.settings import MeshingSettings, to_json
from ..core.worker.helper_process import child_command
from . import addon, region_operators
from .addon import NeedsObjectMode, redraw
from .background import Child, Lane, Task
from .jobs import OnRegions, checked_regions, common_frame, selected_regions
from .mesh_data import mesh_of
from .panel_settings import job_folder_of, method_choices
from .region_objects import region_body
from .region_operators import checked_edge_length, edge_length_in_blender, world_per_blender
from .training import Estimate, estimate_of, estimate_of_failure
from .worker_setup import worker_choice

# -- Estimate the meshes of regions (triangles, time, memory) by the worker, in the background ----
#
# Regions are estimated one after the other. An estimate stays until its region is estimated
# again; :func:`estimate_for` returns whether its inputs have changed since.


MODULE = "jobs.commands.estimate_mesh_command"
DEADLINE_S = 600.0

# Relative: difference of the float32 matrices of an object that has not moved.
_SAME = 1e-5


@dataclass(frozen=True)
class EstimateInputs:
    """Inputs of an estimate."""

    relative: np.ndarray
    """(4, 4) matrix of the region in its frame."""
    rest: tuple[object, ...]

    def matches(self, other: "EstimateInputs") -> bool:
        """Return whether both give the same estimate."""
        scale = float(np.abs(self.relative[:3]).max())
        same = np.allclose(self.relative, other.relative, rtol=0.0, atol=_SAME * scale)
        return self.rest == other.rest and bool(same)


@dataclass
class _State:
    """By the region's session id."""

    # A string: ``typing`` would keep Task[Estimate], and with it bpy, which then crashes at exit.
    running: "dict[int, Task[Estimate]]" = field(default_factory=dict)
    inputs: dict[int, EstimateInputs] = field(default_factory=dict)
    estimates: dict[int, Estimate] = field(default_factory=dict)


_requests = Lane(of_file=True)
_state = _State()


def is_busy() -> bool:
    """Return whether estimates are running."""
    return _requests.busy


def is_waiting(region: bpy.types.Object) -> bool:
    """Return whether a region's estimate is running."""
    running = _state.running.get(region.session_uid)
    return running is not None and running.pending


def estimate_for(scene: bpy.types.Scene, region: bpy.types.Object) -> tuple[Estimate | None, bool]:
    """Return a region's estimate, if there is one, and whether it is up to date."""
    estimate = _state.estimates.get(region.session_uid)
    if estimate is None:
        return None, False
    return estimate, _state.inputs[region.session_uid].matches(inputs_of(scene, region))


def inputs_of(scene: bpy.types.Scene, region: bpy.types.Object) -> EstimateInputs:
    """Return the current inputs of a region's estimate; cheap, for panels."""
    frame = addon.frame_of(region)
    matrix = np.array(region.matrix_world, np.float64)
    scale, folder = 1.0, ""
    if frame is not None:
        of_frame = np.array(frame.matrix_world, np.float64)
        scale = abs(float(np.linalg.det(of_frame[:3, :3]))) ** (1.0 / 3.0)
        folder = str(frame.get(addon.RESULT, ""))
        if scale > 0.0:
            matrix = np.linalg.solve(of_frame, matrix)
    length = edge_length_in_blender(scene, region) / (scale or 1.0)
    choices = method_choices(scene) | {"edge_length": f"{length:.5g}"}
    if length:
        choices["points"] = 0
    shape = region_operators.shape_key(region)
    return EstimateInputs(matrix, (folder, *choices.values(), *shape))


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
    requests = {
        region.session_uid: (_request(scene, region, folder), region_body(region))
        for region in regions
    }
    cancel_estimates()
    for region in regions:
        _state.inputs[region.session_uid] = inputs_of(scene, region)
        _state.estimates.pop(region.session_uid, None)
    for uid, request in requests.items():
        child = Child()
        _state.running[uid] = _requests.submit(
            partial(_run, child, interpreter, *request),
            partial(_keep, uid),
            failed=partial(_keep_failure, uid),
            end=child.end,
        )


def _request(scene: bpy.types.Scene, region: bpy.types.Object, folder: Path) -> dict[str, Any]:
    frame = addon.frame_of(region)
    assert frame is not None  # whoever starts has found the job folder by it
    length = checked_edge_length(scene, region) * world_per_blender(frame)
    values = {**method_choices(scene), "edge_length": length}
    if length:
        values["points"] = 0
    return {"out": str(folder), "meshing": to_json(MeshingSettings(**values)), "threads": 0}


def _run(child: Child, python: str, request: dict[str, Any], body: dict[str, Any]) -> Estimate:
    """Run one estimate of a region file's content; in a thread."""
    with tempfile.TemporaryDirectory(prefix="gwrap-") as folder:
        path = os.path.join(folder, "region.json")
        write_json(Path(path), body)
        text = json.dumps({**request, "region": path}, allow_nan=False)
        command = child_command(MODULE, text, python=python)
        return estimate_of(*child.run(command, DEADLINE_S))


def _keep(uid: int, estimate: Estimate) -> None:
    _state.estimates[uid] = estimate
    _state.running.pop(uid, None)
    redraw()


def _keep_failure(uid: int, error: Exception) -> None:
    _keep(uid, estimate_of_failure(error))


def cancel_estimates() -> None:
    """Cancel running estimates; finished ones stay."""
    _requests.cancel()
    _state.running.clear()


def stop() -> None:
    """Cancel and forget all estimates."""
    cancel_estimates()
    _state.inputs.clear()
    _state.estimates.clear()


# -- Operators of the region list: estimate and delete; checked regions instead of selected ones


class GWRAP_OT_estimate_regions(OnRegions, bpy.types.Operator):
    bl_idname = "gwrap.estimate_regions"
    bl_label = "Estimate"
    bl_description = (
        "Estimate the triangles, time and memory that meshing the selected regions will take"
    )

    checked: BoolProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        return "An estimate is running" if is_busy() else ""

    def regions(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        return checked_regions(context) if self.checked else selected_regions(context)

    def work(self, context: bpy.types.Context) -> None:
        regions = self.regions(context)
        folder = job_folder_of(common_frame(regions))
        start(context.scene, regions, folder, worker_choice(context).python)


class GWRAP_OT_delete_region(NeedsObjectMode, bpy.types.Operator):
    bl_idname = "gwrap.delete_region"
    bl_label = "Delete Region"
    bl_description = "Delete this region; its mesh stays"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    name: StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def work(self, context: bpy.types.Context) -> None:
        thing = context.scene.objects.get(self.name)
        if thing is None or addon.kind_of(thing) != "region":
            raise UsageError(f"The scene has no region {self.name}.", "Choose one of the list.")
        if not thing.is_editable:
            raise UsageError(
                f"{thing.name} is linked from a library.", "Delete it in the library's file."
            )
        mesh = mesh_of(thing) if thing.type == "MESH" else None
        bpy.data.objects.remove(thing)
        if mesh is not None and mesh.users == 0:
            bpy.data.meshes.remove(mesh)


CLASSES: Final = (GWRAP_OT_estimate_regions, GWRAP_OT_delete_region)
