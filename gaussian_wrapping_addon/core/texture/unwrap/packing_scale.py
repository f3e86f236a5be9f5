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


def packing_scale(extents: np.ndarray, side_px: int, padding_px: int, squares: int = 1) -> float:
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

    Parameters
    ----------
    corner_uvs : (f, 3, 2) float64
        All charts at the same scale.
    charts : (f,) int
        Labels from 0.
    squares : int
    polygons : (f,) int, optional
        Polygon of each face: those within one chart are not cut.

    Returns
    -------
    (f,) int32
        New labels; pieces of one label need not be connected.
    """
    labels = charts.astype(np.int64)
    edge_one, edge_two = (corner_uvs[:, k] - corner_uvs[:, 0] for k in (1, 2))
    double = edge_one[:, 0] * edge_two[:, 1] - edge_one[:, 1] * edge_two[:, 0]
    side = math.sqrt(0.5 * float(np.abs(double).sum()) / (USED_SHARE * squares))
    centres = corner_uvs.mean(axis=1)  # (f, 2)
    if polygons is not None:
        centres = _centres_of_polygons(centres, labels, polygons)
    rows = np.arange(len(labels))
    corners = np.arange(3 * len(labels)).reshape(-1, 3)
    for _ in range(MAX_CUTS):
        count = int(labels.max()) + 1
        extents = chart_extents(corner_uvs.reshape(-1, 2), corners, labels)
        low = np.full((count, 2), np.inf)
        np.minimum.at(low, labels, corner_uvs.min(axis=1))
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
