# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator **Bake Photos**; it changes no data of the open file until the bake is done."""

from pathlib import Path
from typing import Final

import bpy

from ...core.errors import UsageError
from ..common import tags
from ..common.error_reporting import OperatorResult
from ..common.redrawing import waiting
from ..jobs.job_guards import ConfirmsFolder, has_worker, no_job_runs
from ..worker import preferred_worker
from .bake_actions import bake_target, start_bake


class GWRAP_OT_bake_photos(ConfirmsFolder, bpy.types.Operator):
    bl_idname = "gwrap.bake_photos"
    bl_label = "Bake Photos"
    bl_description = (
        "Bake the photos onto the selected mesh, edited, retopologised or of your own, in a "
        "background process"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if tags.current_frame(context.scene, context.view_layer.objects.active) is None:
            cls.poll_message_set("Needs a finished job: press Wrap Scene or Import Result first")
            return False
        if context.mode != "OBJECT":
            cls.poll_message_set("Change to Object Mode first")
            return False
        if bake_target(context) is None:
            cls.poll_message_set("Select a mesh to bake the photos onto")
            return False
        return has_worker(cls) and no_job_runs(cls, context)

    def folder(self, context: bpy.types.Context) -> Path | None:
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        return tags.result_folder(frame).parent if frame and frame.get(tags.RESULT) else None

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        thing = bake_target(context)
        if frame is None or thing is None:
            raise UsageError("No mesh is selected.", "Select a mesh, and wrap the scene before.")
        with waiting(context):
            start_bake(context.scene, frame, thing, preferred_worker.worker_choice(context))
        self.report({"INFO"}, f"Baking photos onto {thing.name}")
        return {"FINISHED"}


CLASSES: Final = (GWRAP_OT_bake_photos,)
