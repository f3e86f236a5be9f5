# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that start, stop, find and resume jobs, and check photos; none changes data."""

from pathlib import Path
from typing import Final

import bpy
from bpy.props import StringProperty

from ..core.errors import UsageError
from . import doctor, job_actions, job_timer, known_jobs, tags
from .reporting import ReportsErrors


def no_job_runs(cls: type, context: bpy.types.Context) -> bool:
    """Tell whether no job runs in the scene; the tooltip says why a button is grey."""
    if job_timer.is_running(context.scene.gwrap.job_folder):
        cls.poll_message_set("A job is running; cancel it or wait for it")  # type: ignore[attr-defined]
        return False
    return True


def selected_regions(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected region objects, the active one first."""
    active = context.view_layer.objects.active
    things = [t for t in context.selected_objects if tags.kind_of(t) == "region"]
    return sorted(things, key=lambda t: (t != active, t.name))


class AsksAboutFolder(ReportsErrors):
    """Asks before it works in a folder that only the file names (it may come from elsewhere)."""

    def folder(self, context: bpy.types.Context) -> Path | None:
        """Return the folder that the operator would use."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask where the folder is not known on this machine."""
        folder = self.folder(context)
        if folder is None or known_jobs.is_trusted(folder):
            return self.execute(context)
        return context.window_manager.invoke_confirm(  # type: ignore[no-any-return]
            self,
            event,
            title="Use This Job Folder?",
            message=f"The file names a job folder that is new on this machine: {folder}",
            confirm_text="Use Folder",
        )


class GWRAP_OT_check_photos(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.check_photos"
    bl_label = "Check Photos"
    bl_description = "Look through the photos and camera poses and list what stands in the way"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.scene.gwrap.source:
            cls.poll_message_set("Choose the folder of the photos first")
            return False
        return True

    def work(self, context: bpy.types.Context) -> set[str]:
        from ..core.dataset.check import check_input

        properties = context.scene.gwrap
        properties.findings.clear()
        properties.checked_source = properties.source
        for finding in check_input(job_actions.source_of(context.scene)):
            row = properties.findings.add()
            row.severity = finding.severity
            row.message = finding.message
            row.hint = finding.hint
        errors = sum(row.severity == "error" for row in properties.findings)
        warnings = sum(row.severity == "warning" for row in properties.findings)
        kind = "WARNING" if errors or warnings else "INFO"
        self.report({kind}, f"Photos checked: {errors} errors, {warnings} warnings")
        return {"FINISHED"}


class GWRAP_OT_wrap_scene(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.wrap_scene"
    bl_label = "Wrap Scene"
    bl_description = "Make a textured mesh of the photos in a background process"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.scene.gwrap.source:
            cls.poll_message_set("Choose the folder of the photos first")
            return False
        return no_job_runs(cls, context)

    def work(self, context: bpy.types.Context) -> set[str]:
        folder = job_actions.start_wrap(context.scene, job_actions.worker_choice(context))
        self.report({"INFO"}, f"Wrapping in {folder}")
        return {"FINISHED"}


class GWRAP_OT_mesh_region(AsksAboutFolder, bpy.types.Operator):
    bl_idname = "gwrap.mesh_region"
    bl_label = "Mesh Region"
    bl_description = "Mesh the selected regions from the finished training, without training again"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not selected_regions(context):
            cls.poll_message_set("Select a region box of a wrapped scene")
            return False
        return no_job_runs(cls, context)

    def folder(self, context: bpy.types.Context) -> Path | None:
        frame = tags.frame_of(selected_regions(context)[0])
        return tags.result_folder(frame).parent if frame and frame.get(tags.RESULT) else None

    def work(self, context: bpy.types.Context) -> set[str]:
        regions = selected_regions(context)
        choice = job_actions.worker_choice(context)
        job_actions.start_mesh(context.scene, regions, choice)
        self.report({"INFO"}, f"Meshing {', '.join(r.name for r in regions)}")
        return {"FINISHED"}


class GWRAP_OT_cancel_job(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.cancel_job"
    bl_label = "Cancel"
    bl_description = "Stop the job; it can be resumed from where it stopped"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not job_timer.is_running(context.scene.gwrap.job_folder):
            cls.poll_message_set("No job is running")
            return False
        return True

    def work(self, context: bpy.types.Context) -> set[str]:
        job_timer.cancel(context.scene.gwrap.job_folder)
        return {"FINISHED"}


class GWRAP_OT_resume_job(AsksAboutFolder, bpy.types.Operator):
    bl_idname = "gwrap.resume_job"
    bl_label = "Resume"
    bl_description = "Continue the job from its last checkpoint; finished stages are used again"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.scene.gwrap.job_folder:
            cls.poll_message_set("This scene has no job")
            return False
        return no_job_runs(cls, context)

    def folder(self, context: bpy.types.Context) -> Path | None:
        return Path(bpy.path.abspath(context.scene.gwrap.job_folder))

    def work(self, context: bpy.types.Context) -> set[str]:
        job_actions.resume(context.scene, job_actions.worker_choice(context))
        return {"FINISHED"}


class GWRAP_OT_find_job(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.find_job"
    bl_label = "Find Job"
    bl_description = "Choose the folder of a job that was started earlier or has been moved"

    directory: StringProperty(name="Job Folder", subtype="DIR_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> set[str]:
        if not self.directory:
            raise UsageError("No folder was chosen.", "Choose the folder of a job.")
        folder = Path(bpy.path.abspath(self.directory)).resolve()
        status = job_timer.attach(context.scene, folder)
        known_jobs.remember(folder)
        self.report({"INFO"}, f"Found a job: {status.state.lower()}")
        return {"FINISHED"}


class GWRAP_OT_check_worker(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.check_worker"
    bl_label = "Check Worker"
    bl_description = "Look whether the worker's Python has what jobs need, in the background"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if doctor.is_busy():
            cls.poll_message_set("The check is running")
            return False
        return True

    def work(self, context: bpy.types.Context) -> set[str]:
        doctor.start(job_actions.worker_choice(context).python)
        return {"FINISHED"}


class GWRAP_OT_copy_findings(bpy.types.Operator):
    bl_idname = "gwrap.copy_findings"
    bl_label = "Copy Findings"
    bl_description = "Copy the findings about the worker, to paste them into a bug report"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(doctor.findings())

    def execute(self, context: bpy.types.Context) -> set[str]:
        context.window_manager.clipboard = doctor.as_text()
        return {"FINISHED"}


CLASSES: Final = (
    GWRAP_OT_check_photos,
    GWRAP_OT_wrap_scene,
    GWRAP_OT_mesh_region,
    GWRAP_OT_cancel_job,
    GWRAP_OT_resume_job,
    GWRAP_OT_find_job,
    GWRAP_OT_check_worker,
    GWRAP_OT_copy_findings,
)
