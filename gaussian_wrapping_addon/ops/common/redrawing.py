# SPDX-License-Identifier: GPL-3.0-or-later
"""Ask Blender to draw what has changed."""

from __future__ import annotations

import bpy


def redraw(*kinds: str) -> None:
    """Let all areas of these kinds be drawn again, of 3D views where none is named."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in (kinds or ("VIEW_3D",)):
                area.tag_redraw()
