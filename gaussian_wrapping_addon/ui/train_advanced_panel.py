# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Advanced" of "Train": what the scene needs, limits, where to start."""

from typing import Final

import bpy

from ..ops import watched_jobs
from ..ops.training_choices import DECISIONS, NUMBERS, preset_lines
from .panel_base import CATEGORY, plain
from .text import characters_of, wrapped_label


class GWRAP_PT_train_advanced(bpy.types.Panel):
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = CATEGORY
    bl_parent_id = "GWRAP_PT_train"
    bl_label = "Advanced"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def draw(self, context: bpy.types.Context) -> None:
        plain(self.layout)
        properties = context.scene.gwrap
        training = properties.training
        column = self.layout.column()
        column.enabled = not watched_jobs.is_running(properties.job_folder)
        column.label(text="What the Scene Needs")
        for name in DECISIONS:
            column.row().prop(training, name, expand=True)
        column.separator()
        column.prop(training, "mask_mode")
        column.separator()
        limits = column.column(align=True)
        for name in NUMBERS:
            limits.prop(training, name)
        for line in preset_lines(properties.preset):
            wrapped_label(column, line, characters_of(context))
        column.separator()
        column.prop(training, "start_splat")
        column.operator("gwrap.reset_training", icon="LOOP_BACK")


CLASSES: Final = (GWRAP_PT_train_advanced,)
