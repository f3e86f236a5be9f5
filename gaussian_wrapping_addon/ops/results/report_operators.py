# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that open a job's report and show its pictures."""

from pathlib import Path
from typing import Any, Final

import bpy

from ...core.errors import UsageError
from ..common import known_jobs, tags
from ..common.error_reporting import OperatorResult, ReportsErrors
from .report_data import report_of

MAX_PICTURES = 40
_PICTURES = ("preview.png", "report/held-out-*.jpg", "*/comparison-*.jpg")


def _result_folder(context: bpy.types.Context) -> Path:
    """Return the result folder of the scene if its files may be opened.

    Raises
    ------
    UsageError
        There is none, or it is known from the open file alone, which may come from elsewhere.
    """
    frame = tags.current_frame(context.scene, context.view_layer.objects.active)
    if frame is None:
        raise UsageError("The scene has no result.", "Wrap the scene or import a result.")
    folder = tags.result_folder(frame)
    if not known_jobs.is_trusted(folder.parent):
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


class _NeedsResult(ReportsErrors):
    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if tags.current_frame(context.scene, context.view_layer.objects.active) is None:
            cls.poll_message_set("The scene has no result; wrap it, or import one")
            return False
        return True


class GWRAP_OT_read_report(_NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.read_report"
    bl_label = "Open Report"
    bl_description = "Open report.md: all figures of the job, its warnings and pictures"

    def work(self, context: bpy.types.Context) -> OperatorResult:
        folder = _result_folder(context)
        path = folder / "report.md"
        if path.is_symlink() or not _inside(folder, path):
            raise UsageError(f"{folder} holds no report.md.", "Run the job again.")
        bpy.ops.wm.path_open(filepath=str(path))
        return {"FINISHED"}


class GWRAP_OT_show_pictures(_NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.show_pictures"
    bl_label = "Show Pictures"
    bl_description = "Load the report's pictures; they are listed in the Image Editor"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    def work(self, context: bpy.types.Context) -> OperatorResult:
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
        return {"FINISHED"}


class GWRAP_OT_copy_report(_NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.copy_report"
    bl_label = "Copy"
    bl_description = "Copy the figures and warnings shown here, to paste them elsewhere"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        if not report_of(tags.figures_of(frame)).known:
            cls.poll_message_set("The result has no report; run the job again")
            return False
        return True

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        text = report_of(tags.figures_of(frame)).as_text()
        context.window_manager.clipboard = text.replace(str(Path.home()), "~")
        self.report({"INFO"}, "Copied the report to the clipboard")
        return {"FINISHED"}


CLASSES: Final = (GWRAP_OT_read_report, GWRAP_OT_show_pictures, GWRAP_OT_copy_report)
