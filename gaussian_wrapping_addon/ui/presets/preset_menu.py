# SPDX-License-Identifier: GPL-3.0-or-later
"""The menu of the user's presets: apply, delete, save. It reads its folder when it opens."""

from typing import Final

import bpy

from ...ops.common.translate import tr
from ...ops.presets.preset_files import preset_names, shown_name


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


CLASSES: Final = (GWRAP_MT_presets,)
