# SPDX-License-Identifier: GPL-3.0-or-later
"""Split large photos into overlapping windows, one of which is trained on per iteration."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from ...dataset.camera import Camera

OVERLAP_PX = 16
"""Overlap of neighbouring windows: SSIM leaves out five pixels along the border of each."""


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels."""

    left: int
    top: int
    width: int
    height: int

    def camera(self, camera: Camera) -> Camera:
        """Return the camera cropped to this window."""
        if (self.left, self.top, self.width, self.height) == (0, 0, camera.width, camera.height):
            return camera
        return dataclasses.replace(
            camera,
            width=self.width,
            height=self.height,
            cx=camera.cx - self.left,
            cy=camera.cy - self.top,
        )

    def of(self, image: np.ndarray) -> np.ndarray:
        """Crop an (h, w, ...) image to this window, C-contiguous."""
        part = image[self.top : self.top + self.height, self.left : self.left + self.width]
        return np.ascontiguousarray(part)


def windows(width: int, height: int, max_pixels: int) -> list[Window]:
    """Split an image into equal windows of about ``max_pixels`` at most, row by row.

    A part of the pixels gives nearly the same gradient as all of them, and more steps are worth
    more than exact gradients; so time goes into iterations.
    """
    count = max(1, math.ceil(math.sqrt(width * height / max_pixels)))
    columns = min(count, max(1, width // (2 * OVERLAP_PX)))
    rows = min(count, max(1, height // (2 * OVERLAP_PX)))
    wide, high = _side(width, columns), _side(height, rows)
    lefts = np.linspace(0, width - wide, columns).round().astype(int).tolist()
    tops = np.linspace(0, height - high, rows).round().astype(int).tolist()
    return [Window(left, top, wide, high) for top in tops for left in lefts]


def _side(length: int, parts: int) -> int:
    return length if parts == 1 else math.ceil((length + (parts - 1) * OVERLAP_PX) / parts)
