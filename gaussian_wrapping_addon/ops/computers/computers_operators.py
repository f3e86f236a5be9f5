# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator of the panel "Computers"."""

from typing import Final

import bpy

from ..common.addon import properties_of
from ..common.error_reporting import OperatorResult, ReportsErrors
from ..worker.preferred_worker import worker_choice
from . import farm_actions, farm_calls


class GWRAP_OT_test_computers(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.test_computers"
    bl_label = "Test"
    bl_description = "Ask in the background whether these computers can run jobs"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if properties_of(context.scene).computers.kind == "THIS":
            cls.poll_message_set("Choose Dask to test an address")
            return False
        if farm_calls.is_busy():
            cls.poll_message_set("A request is running; it takes seconds")
            return False
        return True

    def work(self, context: bpy.types.Context) -> OperatorResult:
        farm_actions.test_computers(context.scene, worker_choice(context))
        return {"FINISHED"}


CLASSES: Final = (GWRAP_OT_test_computers,)
