# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Train": preset, time and memory before the start, the job, more training."""

from typing import Any, Final

import bpy

from ...ops.common import tags
from ...ops.common.addon import properties_of
from ...ops.common.translate import tr
from ...ops.jobs import watched_jobs
from ...ops.jobs.panel_state import Stage, primary_of, stage_of
from ...ops.results.report_data import report_of
from ...ops.training import training_estimate
from ..common.panel_base import Readiness, TabPanel, button, plain, table
from ..common.text import characters_of, wrapped_label
from ..jobs.job_view import draw_job, job_readiness

_MAX_VALUE: Final = 18
"""Characters of a value that fit beside its name."""
_NOT_YET: Final = (Stage.NO_DATA, Stage.BAD_DATA)


class GWRAP_PT_train(TabPanel, bpy.types.Panel):
    bl_label = "Train"

    def readiness(self, context: bpy.types.Context) -> Readiness:
        job = job_readiness(context, "WRAP")
        if job is not None:
            return job
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        if frame is None:
            return Readiness("Not trained")
        training = report_of(tags.figures_of(frame)).training
        return Readiness(training.rpartition(", ")[2] or "Trained", "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        plain(layout)
        characters = characters_of(context)
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        if frame is not None:
            training = report_of(tags.figures_of(frame)).training
            words = tr("Trained: {figures}", figures=training) if training else "Trained"
            wrapped_label(layout, words, characters)
        running = watched_jobs.is_running(properties.job_folder)
        column = layout.column()
        column.enabled = not running
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
        if training_estimate.is_busy():
            layout.operator("gwrap.estimate", text="Estimating…", icon="SORTTIME")
            return
        estimate = training_estimate.estimate_for(context.scene)
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
    parts = [line.partition(": ") for line in lines]
    short = [bool(value) and len(value) <= _MAX_VALUE for _, _, value in parts]
    rows = tuple(
        (name.partition(" (")[0], value)
        for (name, _, value), row in zip(parts, short, strict=True)
        if row
    )
    remarks = tuple(
        line for line, row in zip(lines, short, strict=True) if not row and "long side" not in line
    )
    return rows, remarks


CLASSES: Final = (GWRAP_PT_train,)
