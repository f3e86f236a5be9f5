# SPDX-License-Identifier: GPL-3.0-or-later
"""Redraw areas of Blender's windows."""

from __future__ import annotations

import bpy


def redraw(*kinds: str) -> None:
    """Tag all areas of these types for redrawing; by default 3D views."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in (kinds or ("VIEW_3D",)):
                area.tag_redraw()
