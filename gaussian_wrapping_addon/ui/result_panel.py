# SPDX-License-Identifier: GPL-3.0-or-later
"""Sub-panels Result, Report and Scene Tools."""

from __future__ import annotations

from typing import Any, Final

import bpy
import numpy as np

from ..core.errors import WrapError
from ..core.scene.placement import similarity_of_matrix
from ..ops import addon
from ..ops.addon import tr
from ..ops.cameras import cameras_under
from ..ops.placement import point_empties
from ..ops.report_data import report_of
from ..ops.scene_objects import cameras_of, images_of, materials_of, shading_of
from .panel_base import InTab, Readiness, TabPanel, characters_of, table, wrapped_label

# -- The sub-panel "Report" of the result: times, accuracy, regions, warnings ---------------------


_MAX_WARNINGS: Final = 8


class GWRAP_PT_report(InTab, bpy.types.Panel):
    bl_parent_id = "GWRAP_PT_result"
    bl_label = "Report"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return addon.current_frame(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        frame = addon.current_frame(context)
        report = report_of(addon.figures_of(frame))
        if not report.known:
            layout.label(text=tr("No report yet"), icon="INFO", translate=False)
            return
        table(layout, report.rows)
        if report.device_reason:
            wrapped_label(layout, report.device_reason, characters_of(context))
        sections: list[tuple[str, Any, Any]] = [
            (tr("Time of the Stages"), "TIME", report.stages),
            (tr("Model Selection"), "OPTIONS", report.decisions),
            *((region.name, "MESH_DATA", region.rows) for region in report.regions),
        ]
        for title, icon, rows in sections:
            if rows:
                box = layout.box()
                box.label(text=title, icon=icon, translate=False)
                table(box, rows)
        self._warnings(layout, report.warnings, characters_of(context))
        column = layout.column(align=True)
        row = column.row(align=True)
        row.operator("gwrap.read_report", icon="TEXT")
        row.operator("gwrap.copy_report", icon="COPYDOWN")
        column.operator("gwrap.show_pictures", icon="IMAGE_DATA")

    def _warnings(self, layout: Any, warnings: tuple[str, ...], characters: int) -> None:
        if not warnings:
            layout.label(text=tr("No warnings"), icon="CHECKMARK", translate=False)
            return
        box = layout.box()
        for text in warnings[:_MAX_WARNINGS]:
            wrapped_label(box, text, characters - 4, icon="ERROR")
        more = len(warnings) - _MAX_WARNINGS
        if more > 0:
            box.label(text=tr("and {count} more in the report", count=more), translate=False)


# -- The sub-panel "Result": shading, textures, export, the job's files ---------------------------


class GWRAP_PT_result(TabPanel, bpy.types.Panel):
    bl_label = "Result"

    def readiness(self, context: bpy.types.Context) -> Readiness:
        frame = addon.current_frame(context)
        if frame is None:
            return Readiness("No result")
        count = sum(addon.kind_of(child) == "mesh" for child in frame.children)
        text = "1 mesh" if count == 1 else tr("{count} meshes", count=count)
        return Readiness(text, "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        frame = addon.current_frame(context)
        if frame is not None:
            found = materials_of(frame)
            if found:
                shading = shading_of(found[0])
                row = layout.row(align=True)
                for value, text in (("LIT", "Lit"), ("UNLIT", "Unlit")):
                    operator: Any = row.operator(
                        "gwrap.set_shading", text=text, depress=shading == value
                    )
                    operator.shading = value
        column = layout.column(align=True)
        column.operator("gwrap.export_meshes", text="Export…", icon="EXPORT")
        images = images_of(frame) if frame is not None else ()
        if images:
            packed = all(image.packed_file is not None for image in images)
            text = "Unpack Textures" if packed else "Pack Textures"
            pack: Any = column.operator(
                "gwrap.pack_images", text=text, icon="UGLYPACKAGE" if packed else "PACKAGE"
            )
            pack.pack = not packed
        column = layout.column(align=True)
        column.operator("gwrap.import_result", text="Import Result…", icon="IMPORT")
        if frame is not None:
            column.operator("gwrap.open_report", icon="FILE_FOLDER")


# -- The panel "Scene Tools": photo cameras, true scale, ground and origin of a result ------------


class GWRAP_PT_scene_tools(InTab, bpy.types.Panel):
    bl_label = "Scene Tools"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        frame = addon.current_frame(context)
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
                collection, "hide_viewport", text=tr("Show Photo Cameras"),
                translate=False, invert_checkbox=True,
            )  # fmt: skip
        if not cameras_under(frame):
            return
        row: Any = self.layout.row(align=True)
        row.operator("gwrap.view_photo", icon="CAMERA_DATA").step = 0
        row.operator("gwrap.view_photo", text="", icon="TRIA_LEFT").step = -1
        row.operator("gwrap.view_photo", text="", icon="TRIA_RIGHT").step = 1

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
            units = context.scene.unit_settings
            length = (second - first).length * units.scale_length
            distance = bpy.utils.units.to_string(units.system, "LENGTH", length, precision=4)
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


CLASSES: Final = (GWRAP_PT_result, GWRAP_PT_report, GWRAP_PT_scene_tools)
