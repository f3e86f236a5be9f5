# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Texture": size, where its colours come from, further maps, coarser meshes."""

from typing import Final

import bpy

from ..ops import watched_jobs
from .panel_base import Readiness, TabPanel, plain
from .text import characters_of, wrapped_label


class GWRAP_PT_texture(TabPanel, bpy.types.Panel):
    bl_label = "Texture"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def readiness(self, context: bpy.types.Context) -> Readiness:
        properties = context.scene.gwrap
        size = f"{properties.texture_size} px" if properties.texture_size != "0" else "Automatic"
        return Readiness(f"{size}, {properties.texture_source.lower()}", "TEXTURE")

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, context.scene.gwrap
        plain(layout)
        column = layout.column()
        column.enabled = not watched_jobs.is_running(properties.job_folder)
        column.prop(properties, "texture_size", text="Size")
        column.prop(properties, "max_atlases")
        column.row().prop(properties, "texture_source", text="Colors From", expand=True)
        column.prop(properties, "normal_map")
        column.prop(properties, "ambient_occlusion")
        column.prop(properties, "lods")
        text = "Counts for the next Wrap Scene or Mesh Region."
        wrapped_label(layout, text, characters_of(context), icon="INFO")


CLASSES: Final = (GWRAP_PT_texture,)
