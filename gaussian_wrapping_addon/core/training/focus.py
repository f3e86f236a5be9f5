# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training is for: the regions that the user drew, in space and in photos.

See docs/method.md, section 4.7.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import limits
from ..regions.shapes import Region
from ..scene.camera import Camera
from .backend import OVERLAP_PX, Window

SURROUNDINGS_SHARE = 0.25
"""Share of the iterations in which a photo is trained on whole, at half the size: what the regions
stand before, and are lit by, need not be sharp."""

WHOLE_SHARE = 0.85
"""A photo of which the regions cover more is trained on whole, as if there were none."""

MOST_SHOWN = 0.6
"""Share of the photos' pixels that look through the regions from which a training is for all that
they show: what lies behind the regions fills these pixels, too."""

SURROUNDINGS_BUDGET = 0.35
"""Of the largest number of Gaussians, for surroundings; what regions cover of the photos comes on
top."""

_SMALL_PX = 64
"""Longest side of the photos in which regions are looked for."""

OUTSIDE_SIZE = 3.0
"""Distance of the first Gaussians outside the regions over that inside."""


@dataclass(frozen=True)
class Focus:
    """The regions that a training is for.

    Parameters
    ----------
    regions : sequence of Region
        Scene frame.
    """

    regions: Sequence[Region]

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return which of (n, 3) points, scene frame, lie in a region, (n,) bool."""
        found = np.zeros(len(points), np.bool_)
        for region in self.regions:
            found |= region.contains(points)
        return found

    def apart(self, points: np.ndarray) -> np.ndarray:
        """Return how many times as far apart the first Gaussians are at (n, 3) points, (n,)."""
        return np.where(self.contains(points), 1.0, OUTSIDE_SIZE)

    def rectangles(self, camera: Camera) -> list[Window]:
        """Return the rectangles of a photo that show the regions, with a border for SSIM.

        Regions that the photo does not show, or far too small, have none. One rectangle of the
        whole photo comes back where they cover more than :data:`WHOLE_SHARE` of it.
        """
        small, found = _small(camera), []
        for region in self.regions:
            rows, columns = np.nonzero(Focus([region]).shown(small))
            if len(rows):
                top, height = _reach(rows, camera.height, small.height)
                left, width = _reach(columns, camera.width, small.width)
                found.append(Window(left, top, width, height))
        covered = sum(box.width * box.height for box in found)
        if covered > WHOLE_SHARE * camera.width * camera.height:
            return [Window(0, 0, camera.width, camera.height)]
        return found

    def share_of(self, cameras: Sequence[Camera]) -> float:
        """Return the share of the pixels of photos that look through a region."""
        return float(np.mean([self.shown(_small(camera)).mean() for camera in cameras]))

    def shown(self, camera: Camera) -> np.ndarray:
        """Return which pixels of a photo look through a region, (h, w) bool."""
        rays = camera.rays() @ camera.rotation  # (h, w, 3) scene frame, of depth 1
        found = np.zeros(rays.shape[:2], np.bool_)
        for region in self.regions:
            begin, end = np.full(found.shape, limits.NEAR_Z), np.full(found.shape, np.inf)
            for normal, offset in zip(*region.half_spaces, strict=True):
                room, rise = offset - normal @ (camera.center - region.center), rays @ normal
                with np.errstate(divide="ignore", invalid="ignore"):
                    depth = room / rise
                end = np.where(rise > 0.0, np.minimum(end, depth), end)
                begin = np.where(rise < 0.0, np.maximum(begin, depth), begin)
                end[(rise == 0.0) & (room < 0.0)] = -np.inf
            found |= begin < end
        return found


def _small(camera: Camera) -> Camera:
    factor = min(1.0, _SMALL_PX / max(camera.width, camera.height))
    return camera.resized(*(max(1, round(factor * n)) for n in (camera.width, camera.height)))


def _reach(pixels: np.ndarray, length: int, small: int) -> tuple[int, int]:
    """Return first pixel and number of those that pixels of a small photo are of, and a border."""
    scale = length / small
    first = max(0, math.floor((pixels.min() - 1) * scale) - OVERLAP_PX)
    last = min(length, math.ceil((pixels.max() + 2) * scale) + OVERLAP_PX)
    return first, last - first
