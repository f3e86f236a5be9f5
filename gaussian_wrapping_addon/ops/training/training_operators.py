# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the sub-panel "Training": estimate, train more, back to the preset's choices."""

from pathlib import Path
from typing import Final

import bpy

from ...core.errors import UsageError
from ..common import tags
from ..common.addon import properties_of
from ..common.error_reporting import OperatorResult, ReportsErrors
from ..jobs import job_actions
from ..jobs.job_guards import ConfirmsFolder, no_job_runs
from ..worker import preferred_worker
from . import training_estimate


def _frame(context: bpy.types.Context) -> bpy.types.Object | None:
    return tags.current_frame(context.scene, context.view_layer.objects.active)


class GWRAP_OT_estimate(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.estimate"
    bl_label = "Estimate"
    bl_description = "Estimate the time, memory and disk space that this training needs"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not properties_of(context.scene).source:
            cls.poll_message_set("Choose the folder of the photos first")
            return False
        if training_estimate.is_busy():
            cls.poll_message_set("The estimate is running; it takes seconds")
            return False
        return True

    def work(self, context: bpy.types.Context) -> OperatorResult:
        training_estimate.start(context.scene, preferred_worker.worker_choice(context))
        return {"FINISHED"}


class GWRAP_OT_train_more(ConfirmsFolder, bpy.types.Operator):
    bl_idname = "gwrap.train_more"
    bl_label = "Train More"
    bl_description = (
        "Continue the finished training for more iterations, then mesh and texture again"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if _frame(context) is None:
            cls.poll_message_set("Needs a finished training: press Wrap Scene first")
            return False
        return no_job_runs(cls, context)

    def folder(self, context: bpy.types.Context) -> Path | None:
        frame = _frame(context)
        return tags.result_folder(frame).parent if frame and frame.get(tags.RESULT) else None

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = _frame(context)
        if frame is None:
            raise UsageError("The scene has no result.", "Wrap the scene or import a result.")
        job_actions.start_more(context.scene, frame, preferred_worker.worker_choice(context))
        count = properties_of(context.scene).training.more_iterations
        self.report({"INFO"}, f"Training {count:,} iterations more")
        return {"FINISHED"}


class GWRAP_OT_reset_training(bpy.types.Operator):
    bl_idname = "gwrap.reset_training"
    bl_label = "Back to Preset"
    bl_description = "Reset every setting of this panel to that of the preset or to Auto"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return no_job_runs(cls, context)

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        training = properties_of(context.scene).training
        for name in training.bl_rna.properties.keys():  # noqa: SIM118 - no mapping
            if name != "rna_type":
                training.property_unset(name)
        return {"FINISHED"}


CLASSES: Final = (GWRAP_OT_estimate, GWRAP_OT_train_more, GWRAP_OT_reset_training)
