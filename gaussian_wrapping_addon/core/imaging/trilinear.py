# SPDX-License-Identifier: GPL-3.0-or-later
"""Image pyramids stored in one array, and trilinear interpolation for kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..kernels.compiled import inline

MAX_LEVELS = 8


@dataclass(frozen=True)
class Pyramid:
    """Image levels in one flat array, each half the size of the previous one."""

    pixels: np.ndarray
    """(n, 3) uint8 pixels of all levels, row by row."""
    levels: np.ndarray
    """(levels, 3) int64: first pixel, width, height."""


def pyramid(image: np.ndarray, max_levels: int = MAX_LEVELS) -> Pyramid:
    """Build a pyramid by averaging 2 x 2 pixels; odd borders are repeated, so scales are exact.

    Parameters
    ----------
    image : (h, w, 3) uint8
    max_levels : int
        Upper bound; the pyramid also ends at one pixel.
    """
    parts, levels, begin = [], [], 0
    current = image
    while True:
        height, width = current.shape[:2]
        parts.append(current.reshape(-1, 3))
        levels.append((begin, width, height))
        begin += width * height
        if len(levels) >= max_levels or max(width, height) == 1:
            break
        even = np.pad(current, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        total = even[0::2, 0::2].astype(np.uint16) + even[1::2, 0::2]
        total += even[0::2, 1::2]
        total += even[1::2, 1::2]
        current = ((total + 2) >> 2).astype(np.uint8)
    return Pyramid(np.concatenate(parts), np.array(levels, np.int64))


@inline
def bilinear(
    pixels: Any, begin: int, width: int, height: int, x: float, y: float
) -> tuple[float, float, float]:
    """Interpolate three channels at pixel coordinates (centres at + 0.5), clamped at the border."""
    fx = min(max(x - 0.5, 0.0), width - 1.0)
    fy = min(max(y - 0.5, 0.0), height - 1.0)
    ix, iy = int(fx), int(fy)
    jx, jy = min(ix + 1, width - 1), min(iy + 1, height - 1)
    tx, ty = fx - ix, fy - iy
    a, b = begin + iy * width + ix, begin + iy * width + jx
    c, d = begin + jy * width + ix, begin + jy * width + jx
    wa, wb = (1.0 - tx) * (1.0 - ty), tx * (1.0 - ty)
    wc, wd = (1.0 - tx) * ty, tx * ty
    red = wa * pixels[a, 0] + wb * pixels[b, 0] + wc * pixels[c, 0] + wd * pixels[d, 0]
    green = wa * pixels[a, 1] + wb * pixels[b, 1] + wc * pixels[c, 1] + wd * pixels[d, 1]
    blue = wa * pixels[a, 2] + wb * pixels[b, 2] + wc * pixels[c, 2] + wd * pixels[d, 2]
    return red, green, blue


@inline
def trilinear(
    pixels: Any, levels: Any, level: float, x: float, y: float
) -> tuple[float, float, float]:
    """Interpolate between two levels; x and y are pixel coordinates of level 0."""
    top = len(levels) - 1
    clamped = min(max(level, 0.0), float(top))
    low = min(int(clamped), top)
    share = clamped - low
    scale = 1.0 / (1 << low)
    red, green, blue = bilinear(
        pixels, levels[low, 0], levels[low, 1], levels[low, 2], x * scale, y * scale
    )
    if share > 0.0 and low < top:
        half = 0.5 * scale
        red2, green2, blue2 = bilinear(
            pixels, levels[low + 1, 0], levels[low + 1, 1], levels[low + 1, 2], x * half, y * half
        )
        red += share * (red2 - red)
        green += share * (green2 - green)
        blue += share * (blue2 - blue)
    return red, green, blue
