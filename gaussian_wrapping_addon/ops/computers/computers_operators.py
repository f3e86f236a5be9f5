# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the panel "Computers"; none changes data of the open file but the folder shown."""

from pathlib import Path
from typing import Final

import bpy
from bpy.props import StringProperty

from ...core.errors import UsageError
from ...core.farm.flamenco.job_type_file import write_job_type
from ..common.addon import properties_of
from ..common.error_reporting import OperatorResult, ReportsErrors
from ..jobs import panel_state
from ..jobs.job_guards import no_job_runs
from ..worker.preferred_worker import worker_choice
from . import farm_actions, farm_calls, part_watch


def _no_request_runs(cls: type[bpy.types.Operator]) -> bool:
    if farm_calls.is_busy():
        cls.poll_message_set("A request is running; it takes seconds")
        return False
    return True


def _is_submitted(cls: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    look = part_watch.look_at(farm_actions.shown_folder(context.scene))
    if look is None or not look.submitted:
        cls.poll_message_set("No job of this scene was submitted to Flamenco")
        return False
    return _no_request_runs(cls)


class GWRAP_OT_test_computers(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.test_computers"
    bl_label = "Test"
    bl_description = "Ask in the background whether these computers can run jobs"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if properties_of(context.scene).computers.kind == "THIS":
            cls.poll_message_set("Choose Dask or Flamenco to test an address")
            return False
        return _no_request_runs(cls)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        farm_actions.test_computers(context.scene, worker_choice(context))
        return {"FINISHED"}


class GWRAP_OT_submit_farm(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.submit_farm"
    bl_label = "Submit"
    bl_description = "Hand the job of these photos to Flamenco, whose workers run its parts"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        properties = properties_of(context.scene)
        if properties.computers.kind != "FLAMENCO":
            cls.poll_message_set("Choose Flamenco in Computers first")
            return False
        if not properties.source:
            cls.poll_message_set("Choose the folder of the photos first")
            return False
        if panel_state.has_errors(context.scene):
            cls.poll_message_set(
                "The photos cannot be used as they are: see Dataset, then press Check Photos again"
            )
            return False
        return _no_request_runs(cls) and no_job_runs(cls, context)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        folder = farm_actions.submit_scene(context.scene)
        self.report({"INFO"}, f"Submitting {folder}")
        return {"FINISHED"}


class GWRAP_OT_update_farm(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.update_farm"
    bl_label = "Ask Flamenco"
    bl_description = "Ask the Manager how far the job is, with the last lines of failed parts"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _is_submitted(cls, context)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        farm_actions.update(context.scene)
        return {"FINISHED"}


class GWRAP_OT_retry_farm(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.retry_farm"
    bl_label = "Retry"
    bl_description = "Let failed and cancelled parts run again; what is done stays"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _is_submitted(cls, context)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        farm_actions.retry(context.scene)
        return {"FINISHED"}


class GWRAP_OT_cancel_farm(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.cancel_farm"
    bl_label = "Cancel"
    bl_description = "Stop the submitted job on all computers; Retry continues it"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _is_submitted(cls, context)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        farm_actions.cancel(context.scene)
        return {"FINISHED"}


class GWRAP_OT_save_job_type(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.save_job_type"
    bl_label = "Save Job Type"
    bl_description = (
        "Write the script that Flamenco needs into the folder scripts beside flamenco-manager"
    )

    directory: StringProperty(name="Folder", subtype="DIR_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> OperatorResult:
        if not self.directory:
            raise UsageError("No folder was chosen.", "Choose scripts beside flamenco-manager.")
        path = write_job_type(Path(bpy.path.abspath(self.directory)))
        self.report({"INFO"}, f"Wrote {path}; restart the Manager")
        return {"FINISHED"}


CLASSES: Final = (
    GWRAP_OT_test_computers,
    GWRAP_OT_submit_farm,
    GWRAP_OT_update_farm,
    GWRAP_OT_retry_farm,
    GWRAP_OT_cancel_farm,
    GWRAP_OT_save_job_type,
)
