# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw handlers of the 3D views: added once, taken away whole, and no error at every redraw."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import bpy

_logger = logging.getLogger(__name__)


class ViewDrawing:
    """What draws into each 3D view with shown overlays.

    Parameters
    ----------
    what : str
        What is drawn, for the log.
    draw : callable
        Draws into the view of a context.
    forget : callable
        Gives up shaders and batches; they are made again next time.
    """

    def __init__(
        self, what: str, draw: Callable[[bpy.types.Context], None], forget: Callable[[], None]
    ) -> None:
        self.handle: Any = None
        self._what, self._draw, self._forget = what, draw, forget
        self.failed = False

    def start(self) -> None:
        """Start drawing."""
        self.stop()
        self.handle = bpy.types.SpaceView3D.draw_handler_add(self.draw, (), "WINDOW", "POST_VIEW")

    def stop(self) -> None:
        """Stop drawing."""
        if self.handle is not None:
            bpy.types.SpaceView3D.draw_handler_remove(self.handle, "WINDOW")
        self.handle, self.failed = None, False
        self._forget()

    def draw(self, context: bpy.types.Context | None = None) -> None:
        """Draw into the view of a context, the present one by default. The first error is logged.

        Blender calls this.
        """
        try:
            context = context or bpy.context
            space: Any = context.space_data
            if space is not None and space.overlay.show_overlays:
                self._draw(context)
        except Exception:  # an exception here would recur at every redraw
            if not self.failed:
                _logger.exception("%s cannot be drawn", self._what)
            self.failed = True
