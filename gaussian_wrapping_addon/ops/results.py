# SPDX-License-Identifier: GPL-3.0-or-later
"""Results imported and their report shown."""

from pathlib import Path
from typing import Any, Final

import bpy
from bpy.props import EnumProperty, StringProperty

from ..core.errors import UsageError
from ..core.files import real_path
from . import addon, scene_objects
from .addon import NeedsObjectMode, NeedsResult, OperatorResult, needed_frame
from .mesh_data import mesh_of
from .report_data import report_of
from .scene_objects import import_result

# -- Operators that open a job's report and show its pictures -------------------------------------


MAX_PICTURES = 40
_PICTURES = ("preview.png", "report/held-out-*.jpg", "*/comparison-*.jpg")


def _result_folder(context: bpy.types.Context) -> Path:
    """Return the result folder of the scene if its files may be opened.

    Raises UsageError: there is none, or it is known from the open file alone, which may come from
    elsewhere.
    """
    folder = addon.result_folder(needed_frame(context))
    if not addon.is_trusted(folder.parent):
        raise UsageError(
            f"{folder} has not been used on this computer.",
            "Import the result from there, if you trust it.",
        )
    if not (folder / "scene.json").is_file():
        raise UsageError(
            f"{folder} is not a result folder.", "Import the result from where it is now."
        )
    return folder


def _inside(folder: Path, path: Path) -> bool:
    """Return whether a path is a file inside the folder, links resolved."""
    return path.is_file() and path.resolve().is_relative_to(folder.resolve())


class GWRAP_OT_read_report(NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.read_report"
    bl_label = "Open Report"
    bl_description = "Open report.md: all figures of the job, its warnings and pictures"

    def work(self, context: bpy.types.Context) -> None:
        folder = _result_folder(context)
        path = folder / "report.md"
        if path.is_symlink() or not _inside(folder, path):
            raise UsageError(f"{folder} holds no report.md.", "Run the job again.")
        bpy.ops.wm.path_open(filepath=str(path))


class GWRAP_OT_show_pictures(NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.show_pictures"
    bl_label = "Show Pictures"
    bl_description = "Load the report's pictures; they are listed in the Image Editor"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    def work(self, context: bpy.types.Context) -> None:
        folder = _result_folder(context)
        paths = [path for pattern in _PICTURES for path in sorted(folder.glob(pattern))]
        paths = [path for path in paths if _inside(folder, path)][:MAX_PICTURES]
        if not paths:
            raise UsageError(f"{folder} holds no pictures.", "Run the job again.")
        images = []
        for path in paths:
            known = {image.as_pointer() for image in bpy.data.images}
            image = bpy.data.images.load(str(path), check_existing=True)
            if image.as_pointer() in known:
                image.reload()  # a later job may have replaced it
            images.append(image)
        for area in context.screen.areas if context.screen else ():
            if area.type == "IMAGE_EDITOR":
                editor: Any = area.spaces.active
                editor.image = images[min(1, len(images) - 1)]
        self.report({"INFO"}, f"{len(images)} pictures are loaded; the Image Editor lists them")


class GWRAP_OT_copy_report(NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.copy_report"
    bl_label = "Copy"
    bl_description = "Copy the figures and warnings shown here, to paste them elsewhere"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        known = report_of(addon.figures_of(addon.current_frame(context))).known
        unknown = "" if known else "The result has no report; run the job again"
        return super().why_not(context) or unknown

    def work(self, context: bpy.types.Context) -> None:
        frame = addon.current_frame(context)
        text = report_of(addon.figures_of(frame)).as_text()
        context.window_manager.clipboard = text.replace(str(Path.home()), "~")
        self.report({"INFO"}, "Copied the report to the clipboard")


# -- Operators that import results, open their folder and set their shading -----------------------


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

    def work(self, context: bpy.types.Context) -> None:
        if not self.directory:
            raise UsageError("No folder was chosen.", "Choose a job folder or its result folder.")
        folder = real_path(bpy.path.abspath(self.directory))
        if not (folder / "scene.json").exists() and (folder / "result").is_dir():
            folder = folder / "result"
        imported = import_result(folder, context.scene)
        addon.remember(folder.parent)
        faces = sum(len(mesh_of(m).polygons) for m in imported.meshes)
        self.report({"INFO"}, f"{len(imported.meshes)} meshes, {faces} faces")


class GWRAP_OT_open_report(NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.open_report"
    bl_label = "Open Report Folder"
    bl_description = "Show the folder with report.md, the meshes and the textures"

    def work(self, context: bpy.types.Context) -> None:
        folder = addon.result_folder(needed_frame(context))
        # A folder only: the path comes from the .blend, and opening a file could run it.
        if addon.is_remote(folder) or not (folder.is_dir() and (folder / "scene.json").is_file()):
            raise UsageError(
                f"{folder} is not a result folder.", "Import the result from where it is now."
            )
        bpy.ops.wm.path_open(filepath=str(folder))


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

    def work(self, context: bpy.types.Context) -> None:
        for material in scene_objects.materials_of(addon.current_frame(context)):
            scene_objects.set_shading(material, self.shading)


CLASSES: Final = (
    GWRAP_OT_import_result, GWRAP_OT_open_report, GWRAP_OT_set_shading, GWRAP_OT_read_report,
    GWRAP_OT_show_pictures, GWRAP_OT_copy_report,
)  # fmt: skip
