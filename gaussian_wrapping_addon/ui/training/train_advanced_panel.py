# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Advanced" of "Train": model selection, limits, start."""

from typing import Final

import bpy

from ...core.settings.declaration import JOB
from ...ops.common.addon import addon_preferences, properties_of
from ...ops.common.translate import tr
from ...ops.jobs import watched_jobs
from ...ops.jobs.panel_settings import preset_lines
from ..common.panel_base import CATEGORY, plain
from ..common.setting_properties import draw_settings, settings_in
from ..common.text import characters_of, wrapped_label


class GWRAP_PT_train_advanced(bpy.types.Panel):
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = CATEGORY
    bl_parent_id = "GWRAP_PT_train"
    bl_label = "Advanced"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def draw(self, context: bpy.types.Context) -> None:
        plain(self.layout)
        properties = properties_of(context.scene)
        training = properties.training
        column = self.layout.column()
        column.enabled = not watched_jobs.is_running(properties.job_folder)
        shown = settings_in("train_advanced")
        selection = [d for d in shown if d.model_selection]
        limits = [d for d in shown if d.panel is not None and d.panel.preset_if_zero]
        start = [d for d in shown if d.group == JOB]
        others = [d for d in shown if d not in (*selection, *limits, *start)]
        column.label(text=tr("Model Selection"), translate=False)
        for declared in selection:
            column.row().prop(training, declared.property_name, expand=True)
        column.separator()
        draw_settings(column, properties, others)
        column.separator()
        draw_settings(column.column(align=True), properties, limits)
        for line in preset_lines(properties.preset):
            wrapped_label(column, line, characters_of(context))
        column.separator()
        draw_settings(column, properties, start)
        preferences = addon_preferences(context)
        if preferences is not None:  # the machine's, not the file's
            column.prop(preferences, "device")
        column.operator("gwrap.reset_training", icon="LOOP_BACK")


CLASSES: Final = (GWRAP_PT_train_advanced,)
