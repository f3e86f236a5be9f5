# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences: the worker's Python and its options."""

from typing import Final

import bpy
from bpy.props import BoolProperty, StringProperty

from ..core.settings import declared
from .panel_base import plain, property_of
from .worker_setup_view import draw_doctor, draw_setup


class GWRAP_preferences(bpy.types.AddonPreferences):
    bl_idname = __package__.rpartition(".")[0]

    worker_python: StringProperty(  # type: ignore[valid-type]
        name="Worker Python",
        description=(
            "Another Python that has the packages of requirements-worker.txt; empty uses "
            "GAUSSIAN_WRAPPING_PYTHON, or the worker that was set up here"
        ),
        subtype="FILE_PATH",
    )
    wheel_folder: StringProperty(  # type: ignore[valid-type]
        name="Wheel Folder",
        description=(
            "Folder with the wheels of all packages, for a set-up without network; "
            "empty uses pip's package index"
        ),
        subtype="DIR_PATH",
    )
    threads: property_of(declared("threads"))  # type: ignore[valid-type]
    device: property_of(declared("device"))  # type: ignore[valid-type]
    keep_running: BoolProperty(  # type: ignore[valid-type]
        name="Keep Jobs Running After Blender Closes",
        description="Jobs continue after Blender closes; opening the file again finds them",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = plain(self.layout)
        box = layout.box()
        draw_setup(box, context)
        box.prop(self, "wheel_folder")
        for name in ("worker_python", "threads", "device", "keep_running"):
            layout.prop(self, name)
        draw_doctor(layout, context)


CLASSES: Final = (GWRAP_preferences,)
