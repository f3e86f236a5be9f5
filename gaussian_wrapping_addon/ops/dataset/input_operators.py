# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that choose the photos and check them."""

from pathlib import Path
from typing import Final

import bpy
from bpy.props import BoolProperty, StringProperty

from ...core.dataset.photos.image_formats import PHOTO_SUFFIXES
from ...core.dataset.readers.programs.program_files import CAMERA_FILE_SUFFIXES
from ...core.dataset.video.video_file import VIDEO_SUFFIXES
from ...core.errors import UsageError, WrapError
from ..common.addon import properties_of
from ..common.error_reporting import OperatorResult, ReportsErrors
from ..common.translate import tr
from ..jobs import watched_jobs
from ..jobs.job_guards import no_job_runs
from ..training import training_estimate
from ..worker import preferred_worker
from . import photo_check

_INPUT_FILES: Final = (".ply", *CAMERA_FILE_SUFFIXES, *VIDEO_SUFFIXES)
"""Files that are inputs themselves; for any other file, its folder is the input."""


class GWRAP_OT_choose_input(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.choose_input"
    bl_label = "Choose Photos"
    bl_description = (
        "Choose the folder of the photos, of a COLMAP project or with a transforms.json, a video, "
        "the camera file of another program, or the PLY of a splat; it is checked at once"
    )
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's convention

    filepath: StringProperty(name="Input", subtype="FILE_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_image: BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_glob: StringProperty(  # type: ignore[valid-type]
        default=";".join(f"*{suffix}" for suffix in (*_INPUT_FILES, *PHOTO_SUFFIXES)),
        options={"HIDDEN"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return no_job_runs(cls, context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        source = properties_of(context.scene).source
        if source:
            self.filepath = source.rstrip("/\\") + ("" if Path(source).suffix else "/")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, _context: bpy.types.Context) -> None:
        column = self.layout.column(align=True)
        column.label(text=tr("Open the folder with the photos,"), translate=False)
        column.label(text=tr("or select a video,"), translate=False)
        column.label(text=tr("then press Choose Photos."), translate=False)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        if not self.filepath:
            raise UsageError("No folder was chosen.", "Open the folder of the photos.")
        path = Path(bpy.path.abspath(self.filepath))
        if path.suffix.lower() not in _INPUT_FILES and not path.is_dir():
            path = path.parent  # a photo was clicked, or a name that does not exist
        if not path.exists():
            raise UsageError(f"{path} does not exist.", "Choose another folder.")
        properties = properties_of(context.scene)
        if properties.source and Path(bpy.path.abspath(properties.source)) != path:
            if properties.output == properties.job_folder:
                properties.output = ""  # it was made for the photos before
            watched_jobs.detach(context.scene)
        properties.source = str(path)
        training_estimate.forget()
        choice = preferred_worker.worker_choice(context)
        photo_check.start(context.scene, choice, python=choice.python)
        return {"FINISHED"}


class GWRAP_OT_check_photos(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.check_photos"
    bl_label = "Check Photos"
    bl_description = "Check the photos and camera poses and list problems"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not properties_of(context.scene).source:
            cls.poll_message_set("Choose the folder of the photos first")
            return False
        if photo_check.is_busy():
            cls.poll_message_set("The check is running; it takes seconds")
            return False
        return True

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        """Check in a thread: Blender must not wait for a slow disk."""
        try:
            python = preferred_worker.worker_choice(context).python
            photo_check.start(context.scene, python=python)
        except WrapError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def work(self, context: bpy.types.Context) -> OperatorResult:
        properties = properties_of(context.scene)
        photo_check.check_now(context.scene, preferred_worker.worker_choice(context).python)
        errors = sum(row.severity == "error" for row in properties.findings)
        warnings = sum(row.severity == "warning" for row in properties.findings)
        self.report(
            {"WARNING"} if errors or warnings else {"INFO"},
            f"Photos checked: {errors} errors, {warnings} warnings",
        )
        return {"FINISHED"}


CLASSES: Final = (GWRAP_OT_choose_input, GWRAP_OT_check_photos)
