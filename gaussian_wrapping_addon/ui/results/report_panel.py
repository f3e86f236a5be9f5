# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Report" of the result: times, accuracy, regions, warnings."""

from typing import Any, Final

import bpy

from ...ops.common import tags
from ...ops.common.translate import tr
from ...ops.results.report_data import report_of
from ..common.panel_base import table
from ..common.text import characters_of, wrapped_label

_MAX_WARNINGS: Final = 8


class GWRAP_PT_report(bpy.types.Panel):
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Gaussian Wrapping"
    bl_parent_id = "GWRAP_PT_result"
    bl_label = "Report"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return tags.current_frame(context.scene, context.view_layer.objects.active) is not None

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        report = report_of(tags.figures_of(frame))
        if not report.known:
            layout.label(text=tr("No report yet"), icon="INFO", translate=False)
            return
        table(layout, report.rows)
        if report.device_reason:
            wrapped_label(layout, report.device_reason, characters_of(context))
        if report.stages:
            box = layout.box()
            box.label(text=tr("Time of the Stages"), icon="TIME", translate=False)
            table(box, report.stages)
        if report.decisions:
            box = layout.box()
            box.label(text=tr("Model Selection"), icon="OPTIONS", translate=False)
            table(box, report.decisions)
        for region in report.regions:
            box = layout.box()
            box.label(text=region.name, icon="MESH_DATA", translate=False)
            table(box, region.rows)
        self._warnings(layout, report.warnings, characters_of(context))
        column = layout.column(align=True)
        row = column.row(align=True)
        row.operator("gwrap.read_report", icon="TEXT")
        row.operator("gwrap.copy_report", icon="COPYDOWN")
        column.operator("gwrap.show_pictures", icon="IMAGE_DATA")

    def _warnings(self, layout: Any, warnings: tuple[str, ...], characters: int) -> None:
        if not warnings:
            layout.label(text=tr("No warnings"), icon="CHECKMARK", translate=False)
            return
        box = layout.box()
        for text in warnings[:_MAX_WARNINGS]:
            wrapped_label(box, text, characters - 4, icon="ERROR")
        more = len(warnings) - _MAX_WARNINGS
        if more > 0:
            box.label(text=tr("and {count} more in the report", count=more), translate=False)


CLASSES: Final = (GWRAP_PT_report,)
