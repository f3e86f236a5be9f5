# SPDX-License-Identifier: GPL-3.0-or-later
"""How large charts can be in a texture, judged by their boxes."""

from __future__ import annotations

import math

import numpy as np

MAX_PACKING_PX = 1024
"""Packing costs by the texel: it is done on a smaller square, with gutters in proportion."""
ROUNDING_TEXELS = 2
"""A chart takes this more than its box: texels are whole, and touched ones are kept for it."""
FILL_SHARE = 0.8
"""Share of the square that the boxes of charts and their gutters take when they just fit."""
SCALE_STEPS = 30
MIN_SCALE_SHARE = 0.01
"""Of the scale at which the largest chart fills the square: given when not even gutters fit."""


def packing_square(size_px: int, gutter_px: float) -> tuple[int, int]:
    """Return the side and the padding, in whole texels, with which charts are packed."""
    side_px = min(size_px, MAX_PACKING_PX)
    return side_px, math.ceil(gutter_px * side_px / size_px)


def chart_extents(points: np.ndarray, corners: np.ndarray, charts: np.ndarray) -> np.ndarray:
    """Return (c, 2) width and height of charts.

    Parameters
    ----------
    points : (n, 2) float
    corners : (f, 3) int
        Index of the point at each corner.
    charts : (f,) int
        Labels from 0.
    """
    labels = charts.astype(np.int64)
    count = int(labels.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for corner in range(3):
        at = points[corners[:, corner]]
        np.minimum.at(low, labels, at)
        np.maximum.at(high, labels, at)
    return high - low


def scale_that_fits(extents: np.ndarray, side_px: int, padding_px: int) -> float:
    """Return the texels for a unit at which boxes with their padding fill most of a square."""
    low, high = 0.0, side_px / max(float(extents.max()), 1e-30)
    largest = high
    for _ in range(SCALE_STEPS):
        middle = 0.5 * (low + high)
        boxes = float(np.prod(extents * middle + padding_px + ROUNDING_TEXELS, axis=1).sum())
        low, high = (middle, high) if boxes < FILL_SHARE * side_px**2 else (low, middle)
    return max(low, MIN_SCALE_SHARE * largest)
