# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Training": what the scene needs, limits, where to start, train more."""

from typing import Any, Final

import bpy

from ..ops import job_timer, tags, training_estimate
from ..ops.training_choices import DECISIONS, NUMBERS, preset_lines
from .text import characters_of, wrapped_label


class GWRAP_PT_training(bpy.types.Panel):
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Gaussian Wrapping"
    bl_parent_id = "GWRAP_PT_wrap"
    bl_label = "Training"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        properties = context.scene.gwrap
        characters = characters_of(context)
        running = job_timer.is_running(properties.job_folder)
        column = layout.column()
        column.enabled = not running
        self._choices(column, properties, characters)
        if not running:
            self._estimate(layout, context.scene, characters)
            self._more(layout, context)

    def _choices(self, column: Any, properties: Any, characters: int) -> None:
        training = properties.training
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
            wrapped_label(column, line, characters)
        column.separator()
        column.prop(training, "start_splat")
        column.operator("gwrap.reset_training", icon="LOOP_BACK")

    def _estimate(self, layout: Any, scene: bpy.types.Scene, characters: int) -> None:
        layout.separator()
        row = layout.row()
        row.enabled = not training_estimate.is_busy()
        busy = training_estimate.is_busy()
        row.operator("gwrap.estimate", text="Estimating…" if busy else "Estimate", icon="TIME")
        answer = None if busy else training_estimate.answer_for(scene)
        if answer is None:
            return
        for line in answer.lines:
            wrapped_label(layout, line, characters)
        icon = "ERROR"
        for text in filter(None, answer.warnings):
            wrapped_label(layout, text, characters - 4, icon=icon)
            icon = "BLANK1"

    def _more(self, layout: Any, context: bpy.types.Context) -> None:
        if tags.current_frame(context.scene, context.view_layer.objects.active) is None:
            return
        layout.separator()
        box = layout.box().column()
        box.label(text="Finished Training")
        box.prop(context.scene.gwrap.training, "more_iterations")
        box.operator("gwrap.train_more", icon="PLAY")


CLASSES: Final = (GWRAP_PT_training,)
