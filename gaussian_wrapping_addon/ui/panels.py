# SPDX-License-Identifier: GPL-3.0-or-later
"""The N-panel tab "Gaussian Wrapping": Photos, Wrap, Region, Mesh, Result, in working order."""

from typing import Any, Final

import bpy

from ..ops import job_timer, tags
from ..ops.import_operators import materials_of
from ..ops.materials import images_of, shading_of
from .live_view import draw_live
from .text import characters_of, progress_text, wrapped_label

_FINDING_ICONS: Final = {"error": "CANCEL", "warning": "ERROR", "fact": "INFO", "info": "INFO"}
_MAX_FINDINGS: Final = 12


class _Panel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Gaussian Wrapping"


def _plain(layout: Any) -> None:
    layout.use_property_split = True
    layout.use_property_decorate = False


class GWRAP_PT_photos(_Panel, bpy.types.Panel):
    bl_label = "Photos"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        properties = context.scene.gwrap
        _plain(layout)
        layout.prop(properties, "source")
        layout.operator("gwrap.check_photos", icon="VIEWZOOM")
        if properties.checked_source != properties.source:
            return  # the findings are about another folder
        characters = characters_of(context)
        for finding in properties.findings[:_MAX_FINDINGS]:
            box = layout.box()
            icon = _FINDING_ICONS.get(finding.severity, "INFO")
            wrapped_label(box, finding.message, characters - 4, icon=icon)
            if finding.hint:
                wrapped_label(box, finding.hint, characters - 4, icon="BLANK1")
        more = len(properties.findings) - _MAX_FINDINGS
        if more > 0:
            layout.label(text=f"and {more} more", translate=False)


def _draw_job(layout: Any, context: bpy.types.Context, command: str) -> bool:
    """Draw the scene's job where it belongs; tell whether it is running."""
    properties = context.scene.gwrap
    if properties.job_command != command or not properties.job_folder:
        return False
    folder = properties.job_folder
    characters = characters_of(context)
    status = job_timer.status_of(folder)
    if status is None:
        wrapped_label(layout, "The job of this file is not open.", characters, icon="INFO")
        row = layout.row(align=True)
        row.operator("gwrap.find_job", icon="FILE_FOLDER")
        row.operator("gwrap.resume_job", icon="PLAY")
        return False
    if status.active:
        layout.progress(
            factor=min(max(status.fraction, 0.0), 1.0),
            text=progress_text(status.stage, status.fraction, status.seconds_left),
            type="BAR",
        )
        cancelling = status.state == "CANCELLING"
        row = layout.row()
        row.enabled = not cancelling
        row.operator("gwrap.cancel_job", text="Cancelling…" if cancelling else "Cancel", icon="X")
        live = draw_live(layout, folder, status)
        if status.message and not live and not cancelling:
            message = status.message[:1].upper() + status.message[1:]
            wrapped_label(layout, message, characters)
        return True
    if status.state in ("FAILED", "LOST"):
        box = layout.box()
        box.alert = True
        wrapped_label(box, status.error or "The job has failed.", characters - 4, icon="ERROR")
        if status.hint:
            box.alert = False
            wrapped_label(box, status.hint, characters - 4, icon="BLANK1")
    elif status.state == "CANCELLED":
        text = f"Cancelled at {100 * status.fraction:.0f} %. {status.hint}"
        wrapped_label(layout, text, characters, icon="PAUSE")
    elif job_timer.waits_for_object_mode(folder):
        text = "Finished. Leave Edit Mode to see the result."
        wrapped_label(layout, text, characters, icon="INFO")
    elif job_timer.result_to_import(context.scene):
        operator = layout.operator("gwrap.import_result", text="Import Finished Result")
        operator.directory = status.result
    if status.state in ("FAILED", "LOST", "CANCELLED"):
        layout.operator("gwrap.resume_job", icon="PLAY")
    return False


class GWRAP_PT_wrap(_Panel, bpy.types.Panel):
    bl_label = "Wrap"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        properties = context.scene.gwrap
        _plain(layout)
        column = layout.column()
        column.enabled = not job_timer.is_running(properties.job_folder)
        column.prop(properties, "preset")
        column.prop(properties, "texture_size")
        column.prop(properties, "texture_source")
        column.prop(properties, "output")
        if _draw_job(layout, context, "WRAP"):
            return
        row = layout.row()
        row.scale_y = 1.4
        row.operator("gwrap.wrap_scene", icon="MOD_MESHDEFORM")


class GWRAP_PT_region(_Panel, bpy.types.Panel):
    bl_label = "Region"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator_menu_enum(
            "gwrap.add_region_box", "around", text="Add Region Box", icon="CUBE"
        )
        active = context.view_layer.objects.active
        regions = sorted(tags.objects_of_kind(context.scene, "region"), key=lambda t: t.name)
        if regions:
            box = layout.box().column(align=True)
            for region in regions:
                row = box.row(align=True)
                operator = row.operator(
                    "gwrap.select_region",
                    text=region.name,
                    icon="MESH_CUBE" if region.type == "EMPTY" else "MESH_ICOSPHERE",
                    depress=region.select_get(),
                    translate=False,
                )
                operator.name = region.name
                row.prop(region, "hide_viewport", text="", emboss=False)
        else:
            layout.label(text="No regions yet", icon="INFO")
        if active is not None and active.type == "MESH" and not tags.kind_of(active):
            layout.operator("gwrap.use_as_region", icon="MESH_ICOSPHERE")
        row = layout.row(align=True)
        row.operator("gwrap.import_region", text="Import", icon="IMPORT")
        row.operator("gwrap.export_region", text="Export", icon="EXPORT")


class GWRAP_PT_mesh(_Panel, bpy.types.Panel):
    bl_label = "Mesh"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        properties = context.scene.gwrap
        _plain(layout)
        column = layout.column()
        column.enabled = not job_timer.is_running(properties.job_folder)
        column.prop(properties, "resolution")
        if properties.resolution == "EDGE_LENGTH":
            column.prop(properties, "edge_length")
        elif properties.resolution == "POINTS":
            column.prop(properties, "points")
        column.prop(properties, "decimate")
        if properties.decimate:
            column.prop(properties, "target_faces")
        column.prop(properties, "smooth_steps")
        if _draw_job(layout, context, "MESH"):
            return
        selected = [t for t in context.selected_objects if tags.kind_of(t) == "region"]
        row = layout.row()
        row.scale_y = 1.4
        text = "Mesh Region" if len(selected) < 2 else f"Mesh {len(selected)} Regions"
        row.operator("gwrap.mesh_region", text=text, icon="MESH_DATA")


class GWRAP_PT_mesh_advanced(_Panel, bpy.types.Panel):
    bl_parent_id = "GWRAP_PT_mesh"
    bl_label = "Advanced"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        properties = context.scene.gwrap
        _plain(layout)
        column = layout.column()
        column.enabled = not job_timer.is_running(properties.job_folder)
        column.prop(properties, "method")
        if properties.method == "PIVOTS":
            column.prop(properties, "pivots")
        else:
            column.prop(properties, "spacing")
        column.prop(properties, "boundary")
        column.prop(properties, "unseen")
        column.prop(properties, "normal_map")
        column.prop(properties, "ambient_occlusion")
        column.prop(properties, "lods")


class GWRAP_PT_result(_Panel, bpy.types.Panel):
    bl_label = "Result"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        active = context.view_layer.objects.active
        frame = tags.current_frame(context.scene, active)
        if frame is None:
            layout.label(text="No result yet", icon="INFO")
        else:
            found = materials_of(frame)
            if found:
                shading = shading_of(found[0])
                row = layout.row(align=True)
                for value, text in (("LIT", "Lit"), ("UNLIT", "Unlit")):
                    button = row.operator("gwrap.set_shading", text=text, depress=shading == value)
                    button.shading = value
            column = layout.column(align=True)
            column.operator("gwrap.export_meshes", text="Export…", icon="EXPORT")
            images = images_of(frame)
            if images:
                packed = all(image.packed_file is not None for image in images)
                text = "Unpack Textures" if packed else "Pack Textures"
                icon = "UGLYPACKAGE" if packed else "PACKAGE"
                column.operator("gwrap.pack_images", text=text, icon=icon).pack = not packed
        column = layout.column(align=True)
        column.operator("gwrap.open_report", icon="FILE_FOLDER")
        column.operator("gwrap.import_result", icon="IMPORT")


CLASSES: Final = (
    GWRAP_PT_photos,
    GWRAP_PT_wrap,
    GWRAP_PT_region,
    GWRAP_PT_mesh,
    GWRAP_PT_mesh_advanced,
    GWRAP_PT_result,
)
