# SPDX-License-Identifier: GPL-3.0-or-later
"""Sub-panel Train and the menu of presets."""

from typing import Any, Final

import bpy
from bpy.props import IntProperty

from ..core.settings.declaration import JOB
from ..ops import addon, job_timer, training
from ..ops.addon import addon_preferences, properties_of, tr
from ..ops.panel_settings import Stage, preset_lines, primary_of, stage_of
from ..ops.presets import preset_names, shown_name
from ..ops.report_data import report_of
from .job_view import draw_job, job_readiness
from .panel_base import (
    InTab,
    Readiness,
    TabPanel,
    button,
    characters_of,
    column_of_choices,
    draw_settings,
    plain,
    settings_in,
    table,
    with_settings,
    wrapped_label,
)

# -- The menu of the user's presets: apply, delete, save. It reads its folder when it opens -------


class GWRAP_MT_presets(bpy.types.Menu):
    bl_idname = "GWRAP_MT_presets"
    bl_label = "My Presets"
    bl_description = "Settings of training, mesh and texture that were saved under a name"

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator_context = "INVOKE_DEFAULT"
        names = preset_names()
        for name in names:
            row = layout.row(align=True)
            apply = row.operator("gwrap.apply_preset", text=shown_name(name), translate=False)
            apply.name = name  # type: ignore[attr-defined]
            delete = row.operator("gwrap.delete_preset", text="", icon="X")
            delete.name = name  # type: ignore[attr-defined]
        if not names:
            layout.label(text=tr("No presets yet"), translate=False)
        layout.separator()
        layout.operator("gwrap.save_preset", text="Save Preset…", icon="ADD")


# -- Properties of the sub-panel "Train": ``Scene.gwrap.training``; no property has a callback ----


@with_settings("training")
class GWRAP_PG_training(bpy.types.PropertyGroup):
    """Choices that take precedence over the preset; 0 and Auto leave it to preset and photos."""

    more_iterations: IntProperty(  # type: ignore[valid-type]
        name="Iterations",
        description="How many iterations Train More adds to the finished training",
        default=1000, min=1, max=1_000_000, soft_min=100, soft_max=10_000, step=100,
    )  # fmt: skip


PROPERTIES: Final = (GWRAP_PG_training,)


# -- The sub-panel "Train": preset, time and memory before the start, the job, more training ------


_MAX_VALUE: Final = 18
"""Characters of a value that fit beside its name."""
_NOT_YET: Final = (Stage.NO_DATA, Stage.BAD_DATA)


class GWRAP_PT_train(TabPanel, bpy.types.Panel):
    bl_label = "Train"

    def readiness(self, context: bpy.types.Context) -> Readiness:
        job = job_readiness(context, "WRAP")
        if job is not None:
            return job
        frame = addon.current_frame(context)
        if frame is None:
            return Readiness("Not trained")
        training = report_of(addon.figures_of(frame)).training
        return Readiness(training.rpartition(", ")[2] or "Trained", "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = plain(self.layout), properties_of(context.scene)
        characters = characters_of(context)
        frame = addon.current_frame(context)
        if frame is not None:
            training = report_of(addon.figures_of(frame)).training
            words = tr("Trained: {figures}", figures=training) if training else "Trained"
            wrapped_label(layout, words, characters)
        running = job_timer.is_running(properties.job_folder)
        column = column_of_choices(layout, properties)
        column.prop(properties, "preset")  # a list: five names do not fit beside each other
        column.menu("GWRAP_MT_presets", icon="PRESET")
        column.prop(properties, "output")
        if not running and stage_of(context) not in _NOT_YET:
            self._estimate(layout, context, characters)
        if draw_job(layout, context, "WRAP"):
            return
        button(layout, context, "gwrap.wrap_scene", icon="MOD_MESHDEFORM")
        if frame is not None and not running:
            row = layout.row(align=True)
            row.use_property_split = False
            row.prop(properties.training, "more_iterations")
            row.operator("gwrap.train_more", icon="PLAY")

    def _estimate(self, layout: Any, context: bpy.types.Context, characters: int) -> None:
        if not properties_of(context.scene).source:
            return
        if training.is_busy():
            layout.operator("gwrap.estimate", text="Estimating…", icon="SORTTIME")
            return
        estimate = training.estimate_for(context.scene)
        if estimate is None:
            if primary_of(context) == "gwrap.wrap_scene":
                layout.operator("gwrap.estimate", text="Estimate Time and Memory", icon="TIME")
            return
        rows, remarks = estimate_rows(estimate.lines)
        if rows:
            table(layout.box(), rows)
        for text in remarks:
            wrapped_label(layout, text, characters)
        icon = "ERROR"
        for text in filter(None, estimate.warnings):
            wrapped_label(layout, text, characters - 4, icon=icon)
            icon = "BLANK1"


def estimate_rows(lines: tuple[str, ...]) -> tuple[tuple[tuple[str, str], ...], tuple[str, ...]]:
    """Return the figures of an estimate as rows, and its other lines.

    The first line, the photos, is left out: the panel Dataset has it.
    """
    rows, remarks = [], []
    for line in lines:
        name, _, value = line.partition(": ")
        if 0 < len(value) <= _MAX_VALUE:
            rows.append((name.partition(" (")[0], value))
        elif "long side" not in line:
            remarks.append(line)
    return tuple(rows), tuple(remarks)


# -- The sub-panel "Advanced" of "Train": model selection, limits, start --------------------------


class GWRAP_PT_train_advanced(InTab, bpy.types.Panel):
    bl_parent_id = "GWRAP_PT_train"
    bl_label = "Advanced"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def draw(self, context: bpy.types.Context) -> None:
        properties = properties_of(context.scene)
        training = properties.training
        column = column_of_choices(self.layout, properties)
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


CLASSES: Final = (GWRAP_MT_presets, GWRAP_PT_train, GWRAP_PT_train_advanced)
