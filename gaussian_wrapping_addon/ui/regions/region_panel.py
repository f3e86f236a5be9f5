# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel "Region": list of regions, settings of the active one, estimates."""

from typing import Any, Final

import bpy

from ...ops.common import tags
from ...ops.common.addon import properties_of
from ...ops.common.translate import tr
from ...ops.meshing import region_estimate
from ...ops.regions.region_resolution import edge_length_in_blender
from ..common.panel_base import Readiness, TabPanel
from ..common.text import characters_of, count_of_regions, wrapped_label
from ..masks.mask_view import draw_masks

MOST_ROWS: Final = 40
_RESOLUTIONS: Final = {"AUTOMATIC": "automatic", "POINTS": "by number of points"}


class GWRAP_PT_region(TabPanel, bpy.types.Panel):
    bl_label = "Region"

    def readiness(self, context: bpy.types.Context) -> Readiness:
        count = sum(1 for _ in tags.objects_of_kind(context.scene, "region"))
        if not count:
            return Readiness("No regions yet")
        return Readiness(count_of_regions(count), "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator_menu_enum(
            "gwrap.add_region_box", "around", text="Add Region Box", icon="CUBE"
        )
        active = context.view_layer.objects.active
        regions = sorted(tags.objects_of_kind(context.scene, "region"), key=lambda t: t.name)
        if regions:
            box = layout.box().column(align=True)
            for region in regions[:MOST_ROWS]:
                _draw_row(box, region)
            if len(regions) > MOST_ROWS:
                more = tr("and {count} more", count=len(regions) - MOST_ROWS)
                box.label(text=more, translate=False)
        else:
            layout.label(text=tr("No regions yet"), icon="INFO", translate=False)
        if active is not None and tags.kind_of(active) == "region":
            _draw_active(layout, context, active)
        checked = [region for region in regions if properties_of(region).checked]
        if checked:
            row = layout.row(align=True)
            text = tr("Estimate {count} Checked", count=len(checked))
            estimate: Any = row.operator("gwrap.estimate_regions", text=text, icon="TIME")
            estimate.checked = True
            text = tr("Mesh {count} Checked", count=len(checked))
            mesh: Any = row.operator("gwrap.mesh_region", text=text, icon="MESH_DATA")
            mesh.checked = True
        draw_masks(layout, characters_of(context))
        if active is not None and active.type == "MESH" and not tags.kind_of(active):
            layout.operator("gwrap.use_as_region", icon="MESH_ICOSPHERE")
        row = layout.row(align=True)
        row.operator("gwrap.import_region", text="Import", icon="IMPORT")
        row.operator("gwrap.export_region", text="Export", icon="EXPORT")


def _draw_row(layout: Any, region: bpy.types.Object) -> None:
    row = layout.row(align=True)
    row.prop(properties_of(region), "checked", text="")
    operator = row.operator(
        "gwrap.select_region",
        text=region.name,
        icon="MESH_CUBE" if region.type == "EMPTY" else "MESH_ICOSPHERE",
        depress=region.select_get(),
        translate=False,
    )
    operator.name = region.name
    row.prop(region, "hide_viewport", text="", emboss=False)
    row.operator("gwrap.delete_region", text="", icon="X", emboss=False).name = region.name


def _draw_active(layout: Any, context: bpy.types.Context, region: bpy.types.Object) -> None:
    box = layout.box()
    column = box.column()
    column.use_property_split = True
    column.use_property_decorate = False
    column.prop(region, "name")
    scene = context.scene
    own = properties_of(region)
    row = column.row(align=True, heading="Edge Length")
    row.enabled = properties_of(scene).method != "PIVOTS"
    row.prop(own, "own_edge_length", text="")
    value = row.row(align=True)
    value.active = own.own_edge_length
    if own.own_edge_length:
        value.prop(own, "edge_length", text="")
    else:
        value.label(text=_scene_resolution(scene, region), translate=False)
    _draw_estimate(box, context, region)


def _scene_resolution(scene: bpy.types.Scene, region: bpy.types.Object) -> str:
    if properties_of(scene).method == "PIVOTS":
        return tr("none with pivots")
    length = edge_length_in_blender(scene, region)
    if length:
        return tr("{length} (Mesh panel)", length=f"{length:.4g}")
    return tr(_RESOLUTIONS[properties_of(scene).resolution])


def _draw_estimate(layout: Any, context: bpy.types.Context, region: bpy.types.Object) -> None:
    characters = characters_of(context) - 4
    if region_estimate.is_waiting(region):
        layout.label(text=tr("Estimating…"), icon="SORTTIME", translate=False)
        return
    estimate, holds = region_estimate.estimate_for(context.scene, region)
    if estimate is not None:
        column = layout.column(align=True)
        column.active = holds
        if not holds:
            wrapped_label(column, "Before the last change:", characters, icon="INFO")
        for line in estimate.lines:
            wrapped_label(column, line, characters, icon="NONE")
        for line in filter(None, estimate.warnings):
            wrapped_label(column, line, characters, icon="ERROR")
    layout.operator(
        "gwrap.estimate_regions", text="Estimate Again" if estimate else "Estimate", icon="TIME"
    )


CLASSES: Final = (GWRAP_PT_region,)
