# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Result": shading, textures, export, the job's files."""

from typing import Any, Final

import bpy

from ...ops.common import tags
from ...ops.common.translate import tr
from ...ops.results.import_operators import materials_of
from ...ops.results.materials import images_of, shading_of
from ..common.panel_base import Readiness, TabPanel


class GWRAP_PT_result(TabPanel, bpy.types.Panel):
    bl_label = "Result"

    def readiness(self, context: bpy.types.Context) -> Readiness:
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        if frame is None:
            return Readiness("No result")
        count = sum(tags.kind_of(child) == "mesh" for child in frame.children)
        text = "1 mesh" if count == 1 else tr("{count} meshes", count=count)
        return Readiness(text, "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        if frame is not None:
            found = materials_of(frame)
            if found:
                shading = shading_of(found[0])
                row = layout.row(align=True)
                for value, text in (("LIT", "Lit"), ("UNLIT", "Unlit")):
                    operator: Any = row.operator(
                        "gwrap.set_shading", text=text, depress=shading == value
                    )
                    operator.shading = value
        column = layout.column(align=True)
        column.operator("gwrap.export_meshes", text="Export…", icon="EXPORT")
        images = images_of(frame) if frame is not None else ()
        if images:
            packed = all(image.packed_file is not None for image in images)
            text = "Unpack Textures" if packed else "Pack Textures"
            pack: Any = column.operator(
                "gwrap.pack_images", text=text, icon="UGLYPACKAGE" if packed else "PACKAGE"
            )
            pack.pack = not packed
        column = layout.column(align=True)
        column.operator("gwrap.import_result", text="Import Result…", icon="IMPORT")
        if frame is not None:
            column.operator("gwrap.open_report", icon="FILE_FOLDER")


CLASSES: Final = (GWRAP_PT_result,)
