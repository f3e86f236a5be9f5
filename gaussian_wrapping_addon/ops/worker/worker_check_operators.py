# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that check the worker's Python and copy what was found."""

from typing import Final

import bpy

from ..common.error_reporting import OperatorResult, ReportsErrors
from . import preferred_worker, worker_check


class GWRAP_OT_check_worker(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.check_worker"
    bl_label = "Check Worker"
    bl_description = "Check in the background that the worker's Python has all that jobs need"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if worker_check.is_busy():
            cls.poll_message_set("The check is running; it takes seconds")
            return False
        return True

    def work(self, context: bpy.types.Context) -> OperatorResult:
        worker_check.start(preferred_worker.worker_choice(context).python)
        return {"FINISHED"}


class GWRAP_OT_copy_findings(bpy.types.Operator):
    bl_idname = "gwrap.copy_findings"
    bl_label = "Copy Findings"
    bl_description = "Copy the findings about the worker, to paste them into a bug report"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not worker_check.findings():
            cls.poll_message_set("Press Check Worker first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        context.window_manager.clipboard = worker_check.as_text()
        return {"FINISHED"}


CLASSES: Final = (GWRAP_OT_check_worker, GWRAP_OT_copy_findings)
