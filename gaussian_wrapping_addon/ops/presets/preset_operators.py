# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the menu of presets: save, apply, delete."""

from typing import Final

import bpy
from bpy.props import StringProperty

from ..common.error_reporting import OperatorResult, ReportsErrors
from ..common.redrawing import redraw
from ..jobs.job_guards import no_job_runs
from .preset_files import apply_preset, delete_preset, save_preset, shown_name


class GWRAP_OT_save_preset(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.save_preset"
    bl_label = "Save Preset"
    bl_description = (
        "Save the settings of training, mesh and texture under a name; folders, files and regions "
        "are not part of it"
    )

    name: StringProperty(  # type: ignore[valid-type]
        name="Name",
        description="Name of the preset; one of the same name is replaced",
        maxlen=60,
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        return context.window_manager.invoke_props_dialog(self)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        name = save_preset(context.scene, self.name)
        self.report({"INFO"}, f"Saved preset {shown_name(name)}")
        return {"FINISHED"}


class GWRAP_OT_apply_preset(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.apply_preset"
    bl_label = "Apply Preset"
    bl_description = "Set training, mesh and texture as they were saved"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    name: StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return no_job_runs(cls, context)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        notes = apply_preset(context.scene, self.name)
        if notes:
            self.report({"WARNING"}, " ".join(notes))
        redraw()
        return {"FINISHED"}


class GWRAP_OT_delete_preset(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.delete_preset"
    bl_label = "Delete Preset"
    bl_description = "Delete this preset from the user's folder; this cannot be undone"

    name: StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        return context.window_manager.invoke_confirm(self, event)

    def work(self, _context: bpy.types.Context) -> OperatorResult:
        delete_preset(self.name)
        self.report({"INFO"}, f"Deleted preset {shown_name(self.name)}")
        return {"FINISHED"}


CLASSES: Final = (GWRAP_OT_save_preset, GWRAP_OT_apply_preset, GWRAP_OT_delete_preset)
