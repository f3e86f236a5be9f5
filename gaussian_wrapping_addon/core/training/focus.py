# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training is for: the regions that the user drew, in space and in photos.

See docs/method.md, section 4.7.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .. import limits
from ..regions.shapes import Region
from ..scene.camera import Camera
from ..scene.scene import PhotoSource
from .backend import OVERLAP_PX, Window
from .model_selection import OFF, ON, Decision

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
            rows, columns = np.nonzero(_shown(region, small))
            if len(rows):
                top, height = _reach(rows, camera.height, small.height)
                left, width = _reach(columns, camera.width, small.width)
                found.append(Window(left, top, width, height))
        covered = sum(box.width * box.height for box in found)
        if covered > WHOLE_SHARE * camera.width * camera.height:
            return [Window(0, 0, camera.width, camera.height)]
        return found

    def rectangles_in(self, photos: PhotoSource) -> Callable[[int, int], list[Window]]:
        """Return :meth:`rectangles` as a function of photo and divisor that remembers them."""

        @functools.cache
        def of_photo(view: int, divisor: int) -> list[Window]:
            return self.rectangles(photos.camera(view, divisor))

        return of_photo

    def share_of(self, cameras: Sequence[Camera]) -> float:
        """Return the share of the pixels of photos that look through a region."""
        return float(np.mean([self.shown(_small(camera)).mean() for camera in cameras]))

    def shown(self, camera: Camera) -> np.ndarray:
        """Return which pixels of a photo look through a region, (h, w) bool."""
        return np.any([_shown(region, camera) for region in self.regions], axis=0)


@dataclass(frozen=True)
class Favour:
    """What a training is for, how many Gaussians that needs, and why."""

    focus: Focus | None = None
    """``None``: for all that the photos show."""
    budget_share: float = 1.0
    """Of the settings' largest number of Gaussians."""
    decision: Decision | None = None
    """``None`` where no regions were given."""


def favour(
    focus: Focus | None, cameras: Sequence[Camera], is_masked: Callable[[], bool], *, refines: bool
) -> Favour:
    """Decide whether a training is for the regions it was given (docs/method.md, section 4.7).

    Parameters
    ----------
    cameras : sequence of Camera
        Of the photos to train on.
    is_masked : callable
        Whether any of them has a mask; asked only where that decides.
    refines : bool
        Whether the training starts from a splat.
    """
    if focus is None:
        return Favour()
    share = focus.share_of(cameras)
    through = f"{100.0 * share:.1f} % of the photos' pixels look through the regions"
    figures = {"share": share}
    reason = ""
    if share == 0.0:
        reason = "No photo shows the regions."
    elif share > MOST_SHOWN:
        reason = f"{through} (at most {100.0 * MOST_SHOWN:.0f} %): they show little else."
    elif refines:
        reason = "The splat brings its own number of Gaussians."
    elif is_masked():
        reason = "The photos are masked: little is left of their surroundings."
    if reason:
        return Favour(decision=Decision("region_weight", "auto", OFF, reason, figures))
    budget = share + SURROUNDINGS_BUDGET
    evidence = (
        f"{through}: {100.0 * (1.0 - SURROUNDINGS_SHARE):.0f} % of the iterations are for them, "
        f"with at most {100.0 * budget:.0f} % of `max_gaussians`."
    )
    figures["budget_share"] = budget
    return Favour(focus, budget, Decision("region_weight", "auto", ON, evidence, figures))


def _shown(region: Region, camera: Camera) -> np.ndarray:
    """Return which pixels of a photo look through a region, (h, w) bool."""
    rays = camera.rays() @ camera.rotation  # (h, w, 3) scene frame, of depth 1
    begin, end = np.full(rays.shape[:2], limits.NEAR_Z), np.full(rays.shape[:2], np.inf)
    for normal, offset in zip(*region.half_spaces, strict=True):
        room, rise = offset - normal @ (camera.center - region.center), rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = room / rise
        end = np.where(rise > 0.0, np.minimum(end, depth), end)
        begin = np.where(rise < 0.0, np.maximum(begin, depth), begin)
        end[(rise == 0.0) & (room < 0.0)] = -np.inf
    return begin < end


def _small(camera: Camera) -> Camera:
    factor = min(1.0, _SMALL_PX / max(camera.width, camera.height))
    return camera.resized(*(max(1, round(factor * n)) for n in (camera.width, camera.height)))


def _reach(pixels: np.ndarray, length: int, small: int) -> tuple[int, int]:
    """Return first pixel and number of those that pixels of a small photo are of, and a border."""
    scale = length / small
    first = max(0, math.floor((pixels.min() - 1) * scale) - OVERLAP_PX)
    last = min(length, math.ceil((pixels.max() + 2) * scale) + OVERLAP_PX)
    return first, last - first
