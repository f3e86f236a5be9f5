# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that start, stop, find and resume jobs; none changes data of the open file."""

from pathlib import Path
from typing import Final

import bpy
from bpy.props import BoolProperty, StringProperty

from ...core.errors import UsageError
from ...core.files import real_path
from ..common import known_jobs, tags
from ..common.addon import properties_of
from ..common.error_reporting import OperatorResult, ReportsErrors
from ..worker import preferred_worker
from . import job_actions, job_attach, job_timer, panel_state, watched_jobs
from .job_guards import ConfirmsFolder, chosen_regions, has_worker, no_job_runs, selected_regions


class GWRAP_OT_wrap_scene(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.wrap_scene"
    bl_label = "Wrap Scene"
    bl_description = "Make a textured mesh of the photos in a background process"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not properties_of(context.scene).source:
            cls.poll_message_set("Choose the folder of the photos first")
            return False
        if panel_state.has_errors(context.scene):
            cls.poll_message_set(
                "The photos cannot be used as they are: see Dataset, then press Check Photos again"
            )
            return False
        return has_worker(cls) and no_job_runs(cls, context)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        folder = job_actions.start_wrap(context.scene, preferred_worker.worker_choice(context))
        self.report({"INFO"}, f"Wrapping in {folder}")
        return {"FINISHED"}


class GWRAP_OT_mesh_region(ConfirmsFolder, bpy.types.Operator):
    bl_idname = "gwrap.mesh_region"
    bl_label = "Mesh Region"
    bl_description = (
        "Mesh the selected or the checked regions from the finished training, without training "
        "again"
    )

    checked: BoolProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if tags.current_frame(context.scene, context.view_layer.objects.active) is None:
            cls.poll_message_set("Needs a finished training: press Wrap Scene first")
            return False
        if not selected_regions(context) and not chosen_regions(context, checked=True):
            cls.poll_message_set("Select or check a region in the list, or press Add Region Box")
            return False
        return has_worker(cls) and no_job_runs(cls, context)

    def _regions(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        # Without a selection, the checked regions are meant.
        return (not self.checked and selected_regions(context)) or chosen_regions(
            context, checked=True
        )

    def folder(self, context: bpy.types.Context) -> Path | None:
        regions = self._regions(context)
        frame = tags.frame_of(regions[0]) if regions else None
        return tags.result_folder(frame).parent if frame and frame.get(tags.RESULT) else None

    def work(self, context: bpy.types.Context) -> OperatorResult:
        regions = self._regions(context)
        choice = preferred_worker.worker_choice(context)
        job_actions.start_mesh(context.scene, regions, choice)
        self.report({"INFO"}, f"Meshing {', '.join(r.name for r in regions)}")
        return {"FINISHED"}


class GWRAP_OT_cancel_job(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.cancel_job"
    bl_label = "Cancel"
    bl_description = "Stop the job; it can be resumed from where it stopped"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not watched_jobs.is_running(properties_of(context.scene).job_folder):
            cls.poll_message_set("No job is running; Wrap Scene starts one")
            return False
        return True

    def work(self, context: bpy.types.Context) -> OperatorResult:
        job_timer.cancel(properties_of(context.scene).job_folder)
        return {"FINISHED"}


class GWRAP_OT_resume_job(ConfirmsFolder, bpy.types.Operator):
    bl_idname = "gwrap.resume_job"
    bl_label = "Resume"
    bl_description = "Continue the job from its last checkpoint; finished stages are reused"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not properties_of(context.scene).job_folder:
            cls.poll_message_set("This scene has no job; press Wrap Scene, or find its folder")
            return False
        if watched_jobs.is_gone(properties_of(context.scene).job_folder):
            cls.poll_message_set("The job folder is missing; press Find Job if it was moved")
            return False
        return no_job_runs(cls, context)

    def folder(self, context: bpy.types.Context) -> Path | None:
        return Path(bpy.path.abspath(properties_of(context.scene).job_folder))

    def work(self, context: bpy.types.Context) -> OperatorResult:
        job_actions.resume(context.scene, preferred_worker.worker_choice(context))
        return {"FINISHED"}


class GWRAP_OT_find_job(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.find_job"
    bl_label = "Find Job"
    bl_description = "Choose the folder of a job that was started earlier or has been moved"

    directory: StringProperty(name="Job Folder", subtype="DIR_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> OperatorResult:
        if not self.directory:
            raise UsageError("No folder was chosen.", "Choose the folder of a job.")
        folder = real_path(bpy.path.abspath(self.directory))
        status = job_attach.attach(context.scene, folder)
        known_jobs.remember(folder)
        self.report({"INFO"}, f"Found a job: {status.state.lower()}")
        return {"FINISHED"}


CLASSES: Final = (
    GWRAP_OT_wrap_scene,
    GWRAP_OT_mesh_region,
    GWRAP_OT_cancel_job,
    GWRAP_OT_resume_job,
    GWRAP_OT_find_job,
)
