# SPDX-License-Identifier: GPL-3.0-or-later
"""Packing scale of charts, estimated from their bounding boxes."""

from __future__ import annotations

import math

import numpy as np

MAX_PACKING_PX = 1024
"""The cost of packing grows with the texels: a smaller square is used, with scaled gutters."""
ROUNDING_TEXELS = 2
"""Texels added to a box: sizes are rounded up, and touched texels belong to the chart."""
FILL_SHARE = 0.8
"""Share of the square covered by the boxes of charts with gutters when they just fit."""
SCALE_STEPS = 30
WIDE_SHARE = 0.45
"""Share of a square's side: with several squares, wider charts are split to fill each square."""
USED_SHARE = 0.6
"""Approximate share of a square used after packing."""
MAX_CUTS = 12
"""Rounds of halving."""
MIN_SCALE_SHARE = 0.01
"""Share of the scale at which the largest chart fills the square: minimum if gutters do not fit."""


def packing_square(size_px: int, gutter_px: float) -> tuple[int, int]:
    """Return the side and the padding for packing, in whole texels."""
    side_px = min(size_px, MAX_PACKING_PX)
    return side_px, math.ceil(gutter_px * side_px / size_px)


def signed_areas(flat: np.ndarray) -> np.ndarray:
    """Return (f,) areas of (f, 3, 2) triangles, positive when counter-clockwise."""
    one, two = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    return np.asarray(0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]))


def chart_bounds(corner_uvs: np.ndarray, charts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner, (c, 2) each, of (f, 3, 2) charts with labels from 0."""
    labels = charts.astype(np.int64)
    count = int(labels.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for corner in range(3):
        np.minimum.at(low, labels, corner_uvs[:, corner])
        np.maximum.at(high, labels, corner_uvs[:, corner])
    return low, high


def packing_scale(extents: np.ndarray, side_px: int, padding_px: int, squares: int) -> float:
    """Return the texels per unit at which boxes with padding fill most of the squares."""
    low, high = 0.0, side_px / max(float(extents.max()), 1e-30)
    largest = high
    for _ in range(SCALE_STEPS):
        middle = 0.5 * (low + high)
        boxes = float(np.prod(extents * middle + padding_px + ROUNDING_TEXELS, axis=1).sum())
        low, high = (middle, high) if boxes < FILL_SHARE * squares * side_px**2 else (low, middle)
    return max(low, MIN_SCALE_SHARE * largest)


def split_wide_charts(
    corner_uvs: np.ndarray, charts: np.ndarray, squares: int, polygons: np.ndarray | None = None
) -> np.ndarray:
    """Split charts that are too wide for several squares.

    A chart cannot be larger than a square: if one chart holds most of the surface, several squares
    would give no more resolution than one.

    The charts, (f, 3, 2) with labels from 0, are all at the same scale. Polygons within one chart
    are not cut. Returns new labels, (f,) int32; pieces of one label need not be connected.
    """
    labels = charts.astype(np.int64)
    side = math.sqrt(float(np.abs(signed_areas(corner_uvs)).sum()) / (USED_SHARE * squares))
    centres = corner_uvs.mean(axis=1)  # (f, 2)
    if polygons is not None:
        centres = _centres_of_polygons(centres, labels, polygons)
    rows = np.arange(len(labels))
    for _ in range(MAX_CUTS):
        low, high = chart_bounds(corner_uvs, labels)
        count, extents = len(low), high - low
        wide = extents.max(axis=1) > WIDE_SHARE * side
        axis = extents.argmax(axis=1)
        middle = (low + 0.5 * extents)[np.arange(count), axis]
        beyond = wide[labels] & (centres[rows, axis[labels]] > middle[labels])
        if not beyond.any():
            break
        labels[beyond] += count
        labels = np.unique(labels, return_inverse=True)[1].ravel()
    return labels.astype(np.int32)


def _centres_of_polygons(
    centres: np.ndarray, charts: np.ndarray, polygons: np.ndarray
) -> np.ndarray:
    """Return (f, 2) one centre for all faces of a polygon that are in the same chart."""
    pairs = np.stack([charts, polygons], axis=1)
    part = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
    sums = np.stack([np.bincount(part, centres[:, axis]) for axis in range(2)], axis=1)
    return np.asarray((sums / np.bincount(part)[:, None])[part])
