# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Bake": photos onto the active mesh, whatever made it."""

from typing import Final

import bpy

from ...ops.common import tags
from ...ops.common.addon import properties_of
from ...ops.jobs import watched_jobs
from ...ops.meshing.bake_actions import bake_target
from ..common.panel_base import Readiness, TabPanel, button, plain
from ..common.text import characters_of, wrapped_label
from ..jobs.job_view import draw_job, job_readiness


class GWRAP_PT_bake(TabPanel, bpy.types.Panel):
    bl_label = "Bake"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def readiness(self, context: bpy.types.Context) -> Readiness:
        job = job_readiness(context, "BAKE")
        if job is not None:
            return job
        if tags.current_frame(context.scene, context.view_layer.objects.active) is None:
            return Readiness("Needs a result")
        thing = bake_target(context)
        return (
            Readiness("No mesh selected") if thing is None else Readiness(thing.name, "MESH_DATA")
        )

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        plain(layout)
        column = layout.column()
        column.enabled = not watched_jobs.is_running(properties.job_folder)
        bake = properties.bake
        column.prop(bake, "retopology")
        if bake.retopology == "KEEP":
            column.prop(bake, "uvs")
            column.prop(bake, "dense")
        else:
            column.prop(bake, "faces" if bake.retopology == "DECIMATE" else "quads")
        if draw_job(layout, context, "BAKE"):
            return
        characters = characters_of(context)
        thing = bake_target(context)
        if tags.current_frame(context.scene, context.view_layer.objects.active) is None:
            wrapped_label(layout, "Needs a finished job.", characters, icon="INFO")
        elif thing is None:
            text = "Select a mesh: edited, retopologised, or of your own."
            wrapped_label(layout, text, characters, icon="INFO")
        else:
            note = thing.get(tags.BAKE_NOTE, "")
            text = f"{thing.name}: {note}" if isinstance(note, str) and note else thing.name
            wrapped_label(layout, text, characters)
        button(layout, context, "gwrap.bake_photos", icon="RENDER_STILL")
        text = "Size, maps and colours are those of Texture."
        wrapped_label(layout, text, characters, icon="INFO")


CLASSES: Final = (GWRAP_PT_bake,)
