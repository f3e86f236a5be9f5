# SPDX-License-Identifier: GPL-3.0-or-later
"""Look through the photo cameras, one after another, with their photos behind the mesh."""

from typing import Any, Final

import bpy
from bpy.props import IntProperty

from ...core.errors import DatasetError, UsageError
from ..common import tags
from ..common.error_reporting import NeedsResult, OperatorResult, ReportsErrors
from .camera_objects import bring_forward, cameras_under, look_through, show_photo


class GWRAP_OT_view_photo(NeedsResult, ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.view_photo"
    bl_label = "Look Through Camera"
    bl_description = (
        "Look through a photo's camera with the photo behind the mesh; the render gets the "
        "photo's size and pixel aspect"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    step: IntProperty(  # type: ignore[valid-type]
        name="Step",
        description="0: the selected photo camera; otherwise photos to step from the current one",
        options={"SKIP_SAVE"},
    )

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame, thing = self._camera(context)
        bring_forward(frame, thing)
        look_through(context.scene, thing)
        for area in context.screen.areas if context.screen else ():
            if area.type == "VIEW_3D":
                view: Any = area.spaces.active
                view.region_3d.view_perspective = "CAMERA"
        try:
            show_photo(thing)
        except DatasetError as error:
            self.report({"WARNING"}, str(error))
        return {"FINISHED"}

    def _camera(self, context: bpy.types.Context) -> tuple[bpy.types.Object, bpy.types.Object]:
        active = context.view_layer.objects.active
        frame = tags.current_frame(context.scene, active)
        cameras = cameras_under(frame) if frame is not None else []
        if frame is None or not cameras:
            raise UsageError("The result has no photo cameras.", "Import the result again.")
        present = context.scene.camera
        if self.step == 0:
            return frame, next((c for c in (active, present) if c in cameras), cameras[0])
        if present not in cameras:
            return frame, cameras[0 if self.step > 0 else -1]
        return frame, cameras[(cameras.index(present) + self.step) % len(cameras)]


CLASSES: Final = (GWRAP_OT_view_photo,)
