# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the region list: estimate and delete; checked regions instead of selected ones."""

from pathlib import Path
from typing import Final

import bpy
from bpy.props import BoolProperty, StringProperty

from ...core.errors import UsageError
from ..common import tags
from ..common.error_reporting import NeedsObjectMode, OperatorResult
from ..common.mesh_data import mesh_of
from ..jobs import job_actions, scene_folders
from ..jobs.job_guards import ConfirmsFolder, chosen_regions
from ..worker import preferred_worker
from . import region_estimate


class GWRAP_OT_estimate_regions(ConfirmsFolder, bpy.types.Operator):
    bl_idname = "gwrap.estimate_regions"
    bl_label = "Estimate"
    bl_description = (
        "Estimate the triangles, time and memory that meshing the selected regions will take"
    )

    checked: BoolProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if region_estimate.is_busy():
            cls.poll_message_set("An estimate is running")
            return False
        return True

    def folder(self, context: bpy.types.Context) -> Path | None:
        regions = chosen_regions(context, checked=self.checked)
        frame = tags.frame_of(regions[0]) if regions else None
        return tags.result_folder(frame).parent if frame and frame.get(tags.RESULT) else None

    def work(self, context: bpy.types.Context) -> OperatorResult:
        regions = chosen_regions(context, checked=self.checked)
        folder = scene_folders.job_folder_of(job_actions.common_frame(regions))
        python = preferred_worker.worker_choice(context).python
        region_estimate.start(context.scene, regions, folder, python)
        return {"FINISHED"}


class GWRAP_OT_delete_region(NeedsObjectMode, bpy.types.Operator):
    bl_idname = "gwrap.delete_region"
    bl_label = "Delete Region"
    bl_description = "Delete this region; its mesh stays"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    name: StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def work(self, context: bpy.types.Context) -> OperatorResult:
        thing = context.scene.objects.get(self.name)
        if thing is None or tags.kind_of(thing) != "region":
            raise UsageError(f"The scene has no region {self.name}.", "Choose one of the list.")
        if not thing.is_editable:
            raise UsageError(
                f"{thing.name} is linked from a library.", "Delete it in the library's file."
            )
        mesh = mesh_of(thing) if thing.type == "MESH" else None
        bpy.data.objects.remove(thing)
        if mesh is not None and mesh.users == 0:
            bpy.data.meshes.remove(mesh)
        return {"FINISHED"}


CLASSES: Final = (GWRAP_OT_estimate_regions, GWRAP_OT_delete_region)
