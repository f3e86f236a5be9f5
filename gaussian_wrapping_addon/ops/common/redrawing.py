# SPDX-License-Identifier: GPL-3.0-or-later
"""Redraw areas of Blender's windows, and show that Blender is busy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy


def redraw(*kinds: str) -> None:
    """Tag all areas of these types for redrawing; by default 3D views."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in (kinds or ("VIEW_3D",)):
                area.tag_redraw()


def redraw_sidebars() -> None:
    """Let the side panels of 3D views be drawn again, but not the views."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()


def redraw_status_bars() -> None:
    """Let the status bars of all windows be drawn again; they are in no screen's areas.

    They listen to the name of the view layer, which nothing here changes.
    """
    if not bpy.app.background:
        bpy.msgbus.publish_rna(key=(bpy.types.ViewLayer, "name"))


@contextmanager
def waiting(context: bpy.types.Context) -> Iterator[None]:
    """Show the wait cursor while Blender is blocked."""
    window = None if bpy.app.background else context.window
    if window is not None:
        window.cursor_modal_set("WAIT")
    try:
        yield
    finally:
        if window is not None:
            window.cursor_modal_restore()
