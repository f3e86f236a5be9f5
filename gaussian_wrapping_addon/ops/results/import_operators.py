# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that import results, open their folder and set their shading."""

from typing import Final

import bpy
from bpy.props import EnumProperty, StringProperty

from ...core.errors import UsageError
from ...core.files import real_path
from ..common import known_jobs, tags
from ..common.error_reporting import NeedsObjectMode, NeedsResult, OperatorResult, ReportsErrors
from ..common.mesh_data import mesh_of
from . import materials
from .scene_objects import import_result


class GWRAP_OT_import_result(NeedsObjectMode, bpy.types.Operator):
    bl_idname = "gwrap.import_result"
    bl_label = "Import Result"
    bl_description = "Import a finished job's meshes, cameras and regions, or update them"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    directory: StringProperty(name="Result Folder", subtype="DIR_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        if self.directory:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> OperatorResult:
        if not self.directory:
            raise UsageError("No folder was chosen.", "Choose a job folder or its result folder.")
        folder = real_path(bpy.path.abspath(self.directory))
        if not (folder / "scene.json").exists() and (folder / "result").is_dir():
            folder = folder / "result"
        imported = import_result(folder, context.scene)
        known_jobs.remember(folder.parent)
        faces = sum(len(mesh_of(m).polygons) for m in imported.meshes)
        self.report({"INFO"}, f"{len(imported.meshes)} meshes, {faces} faces")
        return {"FINISHED"}


class GWRAP_OT_open_report(NeedsResult, ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.open_report"
    bl_label = "Open Report Folder"
    bl_description = "Show the folder with report.md, the meshes and the textures"

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        if frame is None:
            raise UsageError("The scene has no result.", "Wrap the scene or import a result.")
        folder = tags.result_folder(frame)
        # A folder only: the path comes from the .blend, and opening a file could run it.
        if known_jobs.is_remote(folder) or not (
            folder.is_dir() and (folder / "scene.json").is_file()
        ):
            raise UsageError(
                f"{folder} is not a result folder.", "Import the result from where it is now."
            )
        bpy.ops.wm.path_open(filepath=str(folder))
        return {"FINISHED"}


class GWRAP_OT_set_shading(NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.set_shading"
    bl_label = "Set Shading"
    bl_description = "Show the photo texture lit by the scene's lights, or as photographed"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    shading: EnumProperty(  # type: ignore[valid-type]
        items=(
            ("LIT", "Lit", "The scene's lights fall on the mesh"),
            ("UNLIT", "Unlit", "The texture as photographed, whatever the lights"),
        )
    )

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        for material in materials_of(frame):
            materials.set_shading(material, self.shading)
        return {"FINISHED"}


def materials_of(frame: bpy.types.Object | None) -> list[bpy.types.Material]:
    """Return our materials on the meshes of a result, coarser and lighter ones included."""
    children = frame.children if frame is not None else ()
    found = [
        material
        for child in children
        if tags.kind_of(child) in tags.WITH_TEXTURE
        for slot in child.material_slots
        if (material := slot.material) is not None and materials.shading_of(material) is not None
    ]
    return list(dict.fromkeys(found))


CLASSES: Final = (
    GWRAP_OT_import_result,
    GWRAP_OT_open_report,
    GWRAP_OT_set_shading,
)
