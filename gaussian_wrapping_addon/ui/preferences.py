# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences: which Python works, and how."""

from typing import Final

import bpy
from bpy.props import BoolProperty, IntProperty, StringProperty

from ..ops import doctor
from .text import wrapped_label


class GWRAP_preferences(bpy.types.AddonPreferences):
    bl_idname = __package__.rpartition(".")[0]

    worker_python: StringProperty(  # type: ignore[valid-type]
        name="Worker Python",
        description=(
            "Python that has the packages of requirements-worker.txt; "
            "empty uses GAUSSIAN_WRAPPING_PYTHON or Blender's own Python"
        ),
        subtype="FILE_PATH",
    )
    threads: IntProperty(  # type: ignore[valid-type]
        name="Threads",
        description="Processor threads for jobs; 0 uses all",
        default=0,
        min=0,
        max=1024,
    )
    keep_running: BoolProperty(  # type: ignore[valid-type]
        name="Keep Jobs Running After Blender Closes",
        description="Jobs go on when Blender ends; opening the file again finds them",
        default=False,
    )

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "worker_python")
        layout.prop(self, "threads")
        layout.prop(self, "keep_running")
        row = layout.row()
        row.operator("gwrap.check_worker", icon="VIEWZOOM")
        row.operator("gwrap.copy_findings", icon="COPYDOWN")
        if doctor.is_busy():
            layout.label(text="Checking…", icon="TIME")
        for finding in doctor.findings():
            icon = "CHECKMARK" if finding.good else "ERROR"
            wrapped_label(layout, f"{finding.subject}: {finding.finding}", 90, icon=icon)
            if not finding.good and finding.hint:
                wrapped_label(layout, finding.hint, 90, icon="BLANK1")


CLASSES: Final = (GWRAP_preferences,)
