# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Texture": size, source of the colours, further maps, coarser meshes."""

from typing import Final

import bpy

from ...ops.common.addon import properties_of
from ...ops.common.translate import tr
from ...ops.jobs import watched_jobs
from ..common.panel_base import Readiness, TabPanel, plain
from ..common.setting_properties import draw_settings, settings_in
from ..common.text import characters_of, wrapped_label


class GWRAP_PT_texture(TabPanel, bpy.types.Panel):
    bl_label = "Texture"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def readiness(self, context: bpy.types.Context) -> Readiness:
        properties = properties_of(context.scene)
        size = f"{properties.texture_size} px" if properties.texture_size != "0" else "Automatic"
        photos = properties.texture_source == "PHOTOS"
        text = "{size}, photos" if photos else "{size}, gaussians"
        return Readiness(tr(text, size=tr(size)), "TEXTURE")

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        plain(layout)
        column = layout.column()
        column.enabled = not watched_jobs.is_running(properties.job_folder)
        draw_settings(column, properties, settings_in("texture"))
        text = "Applies to the next Wrap Scene, Mesh Region or Bake Photos."
        wrapped_label(layout, text, characters_of(context), icon="INFO")


CLASSES: Final = (GWRAP_PT_texture,)
