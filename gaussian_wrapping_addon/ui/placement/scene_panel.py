# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel "Scene Tools": photo cameras, true scale, ground and origin of a result."""

from typing import Any, Final

import bpy
import numpy as np

from ...core.dataset.frames.placement import similarity_of_matrix
from ...core.errors import WrapError
from ...ops.cameras.camera_objects import cameras_under
from ...ops.common import tags
from ...ops.common.translate import tr
from ...ops.placement.picked_points import point_empties
from ...ops.results.scene_objects import cameras_of
from ..common.text import characters_of, wrapped_label


class GWRAP_PT_scene_tools(bpy.types.Panel):
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Gaussian Wrapping"
    bl_label = "Scene Tools"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        if frame is None:
            layout.label(text=tr("No result yet"), icon="INFO", translate=False)
            return
        self._cameras(context, frame)
        self._points(context)
        column = layout.column(align=True)
        column.operator("gwrap.set_scale", icon="DRIVER_DISTANCE")
        row = column.row(align=True)
        row.operator("gwrap.set_ground", icon="GRID")
        row.operator("gwrap.auto_ground", text="Auto")
        column.operator_menu_enum("gwrap.set_origin", "target", icon="OBJECT_ORIGIN")
        self._placement(context, frame)

    def _cameras(self, context: bpy.types.Context, frame: bpy.types.Object) -> None:
        collection = cameras_of(frame.users_collection[0]) if frame.users_collection else None
        if collection is not None:
            self.layout.prop(
                collection,
                "hide_viewport",
                text=tr("Show Photo Cameras"),
                translate=False,
                invert_checkbox=True,
            )
        if not cameras_under(frame):
            return
        row = self.layout.row(align=True)
        selected: Any = row.operator("gwrap.view_photo", icon="CAMERA_DATA")
        selected.step = 0
        previous: Any = row.operator("gwrap.view_photo", text="", icon="TRIA_LEFT")
        previous.step = -1
        following: Any = row.operator("gwrap.view_photo", text="", icon="TRIA_RIGHT")
        following.step = 1

    def _points(self, context: bpy.types.Context) -> None:
        layout, characters = self.layout, characters_of(context)
        if context.mode == "EDIT_MESH":
            wrapped_label(layout, "Select vertices of the result.", characters, icon="VERTEXSEL")
            return
        layout.operator("gwrap.add_point", icon="EMPTY_AXIS")
        points = point_empties(context)
        if not points:
            text = "Add points at the 3D cursor, or select vertices in Edit Mode."
            wrapped_label(layout, text, characters, icon="INFO")
        elif len(points) == 2:
            first, second = (p.matrix_world.translation for p in points)
            distance = bpy.utils.units.to_string(
                context.scene.unit_settings.system,
                "LENGTH",
                (second - first).length * context.scene.unit_settings.scale_length,
                precision=4,
            )
            text = tr("2 points selected, {distance} apart", distance=distance)
            layout.label(text=text, translate=False)
        else:
            text = "1 point selected" if len(points) == 1 else "{count} points selected"
            layout.label(text=tr(text, count=len(points)), translate=False)

    def _placement(self, context: bpy.types.Context, frame: bpy.types.Object) -> None:
        layout = self.layout
        try:
            # As last drawn: a panel must not make Blender evaluate the scene.
            placement = similarity_of_matrix(np.array(frame.matrix_world), frame.name)
        except WrapError as error:
            wrapped_label(layout, str(error), characters_of(context), icon="ERROR")
        else:
            text = tr("Scale {factor}", factor=f"{placement.scale:.6g}")
            layout.label(text=text, translate=False)
        row = layout.row(align=True)
        row.operator("gwrap.keep_placement", text="Keep", icon="FILE_TICK")
        row.operator("gwrap.reset_placement", text="Reset", icon="LOOP_BACK")


CLASSES: Final = (GWRAP_PT_scene_tools,)
