# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Mesh": resolution of the selected regions, and the meshing job."""

from typing import Final

import bpy

from ...ops.common import tags
from ...ops.common.addon import properties_of
from ...ops.common.translate import tr
from ...ops.jobs import watched_jobs
from ...ops.jobs.job_guards import selected_regions
from ..common.panel_base import CATEGORY, Readiness, TabPanel, button, plain
from ..common.setting_properties import draw_settings, settings_in
from ..common.text import characters_of, count_of_regions, wrapped_label
from ..jobs.job_view import draw_job, job_readiness


class GWRAP_PT_mesh(TabPanel, bpy.types.Panel):
    bl_label = "Mesh"

    def readiness(self, context: bpy.types.Context) -> Readiness:
        job = job_readiness(context, "MESH")
        if job is not None:
            return job
        if tags.current_frame(context.scene, context.view_layer.objects.active) is None:
            return Readiness("Needs a training")
        count = len(selected_regions(context))
        if not count:
            return Readiness("No region selected")
        return Readiness(count_of_regions(count), "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        plain(layout)
        selected = selected_regions(context)
        column = layout.column()
        column.enabled = not watched_jobs.is_running(properties.job_folder)
        column.prop(properties, "resolution")
        draw_settings(column, properties, settings_in("mesh"))
        if draw_job(layout, context, "MESH"):
            return
        characters = characters_of(context)
        if tags.current_frame(context.scene, context.view_layer.objects.active) is None:
            wrapped_label(layout, "Needs a finished training.", characters, icon="INFO")
        elif selected:
            names = ", ".join(region.name for region in selected)
            text = "Region: {names}" if len(selected) == 1 else "Regions: {names}"
            wrapped_label(layout, tr(text, names=names), characters)
        else:
            text = "Select a region above, or add a region box."
            wrapped_label(layout, text, characters, icon="INFO")
        count = len(selected)
        text = "Mesh Region" if count < 2 else tr("Mesh {count} Regions", count=count)
        button(layout, context, "gwrap.mesh_region", text=text, icon="MESH_DATA")


class GWRAP_PT_mesh_advanced(bpy.types.Panel):
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = CATEGORY
    bl_parent_id = "GWRAP_PT_mesh"
    bl_label = "Advanced"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        plain(layout)
        column = layout.column()
        column.enabled = not watched_jobs.is_running(properties.job_folder)
        column.prop(properties, "decimate")
        draw_settings(column, properties, settings_in("mesh_advanced"))


CLASSES: Final = (GWRAP_PT_mesh, GWRAP_PT_mesh_advanced)
