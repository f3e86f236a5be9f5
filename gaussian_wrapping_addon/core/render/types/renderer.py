# SPDX-License-Identifier: GPL-3.0-or-later
"""What renders whole views, on whatever device."""

from __future__ import annotations

from typing import Any, Protocol

from ...dataset.camera import Camera
from .options import RenderOptions


class Renderer(Protocol):
    """Renders one view after the other.

    Implemented by :class:`~..view_renderer.ViewRenderer` and
    :class:`~..cuda.device_renderer.DeviceRenderer`.
    """

    def render(self, gaussians: Any, camera: Camera, options: RenderOptions) -> Any:
        """Return a view of ``RawArrays`` with images and statistics as numpy arrays.

        They are valid until the next call. ``backward`` takes ``ImageGradients`` and returns
        ``VisibleGradients``.
        """
