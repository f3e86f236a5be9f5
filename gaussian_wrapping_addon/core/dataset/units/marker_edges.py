# SPDX-License-Identifier: GPL-3.0-or-later
"""Corners of a printed marker to hundredths of a pixel: intersections of lines fitted to its edges.

A corner is rounded by the lens and the pixels, which moves it inwards; edges are not
(docs/method.md, section 13.3).
"""

from __future__ import annotations

import numpy as np

MIN_MODULE_PX = 2.5
"""Size of a bit of the marker below which the profile across an edge would reach the bits."""
_END_SHARE = 0.12
"""Share of an edge at either end that its line is not fitted to: corners are rounded there."""
_MAX_HALF_WIDTH_PX = 5.0
_MODULE_SHARE = 0.7
"""Of the black border, which is one module wide, that a profile reaches into."""
_STEP_PX = 0.25
_MIN_CONTRAST = 20.0
"""Levels of 255 between the two sides of an edge."""
_MIN_GOOD_SHARE = 0.5
"""Of the profiles of an edge that have to show it."""
_ROUNDS = 3
_MAX_MOVE_PX = 2.5
"""A corner that moves further was not the marker's."""


def refined_corners(grey: np.ndarray, corners: np.ndarray, modules: int) -> np.ndarray | None:
    """Return the marker's corners as intersections of its edges.

    Parameters
    ----------
    grey : (h, w) uint8
    corners : (4, 2) float64
        Corners to a pixel or so, around the marker; the first pixel's centre is (0.5, 0.5).
    modules : int
        Bits of the marker along a side, the black border included.

    Returns
    -------
    (4, 2) float64 or None
        None if the marker is too small in the photo, or an edge is not clear.
    """
    corners = np.asarray(corners, np.float64)
    sides = np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1)
    module = float(sides.min()) / modules
    if module < MIN_MODULE_PX:
        return None
    half = min(_MODULE_SHARE * module, _MAX_HALF_WIDTH_PX)
    found = corners
    for _ in range(_ROUNDS):
        lines = [_edge_line(grey, found, k, half) for k in range(4)]
        crossings = [_crossing(lines[k - 1], lines[k]) for k in range(4)]
        if any(c is None for c in crossings):
            return None
        found = np.array(crossings, np.float64)
        if np.linalg.norm(found - corners, axis=1).max() > _MAX_MOVE_PX:
            return None
    return found


def _edge_line(
    grey: np.ndarray, corners: np.ndarray, k: int, half: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return point and unit normal of the line along the edge from corner k to the next."""
    start, end = corners[k], corners[(k + 1) % 4]
    along = end - start
    length = float(np.linalg.norm(along))
    if length < 4.0:
        return None
    along = along / length
    normal = np.array([along[1], -along[0]])
    if (corners.mean(0) - start) @ normal > 0.0:
        normal = -normal  # outwards: from black to white
    count = int(np.clip(length, 8, 96))
    shares = np.linspace(_END_SHARE, 1.0 - _END_SHARE, count)
    base = start + shares[:, None] * (length * along)  # (n, 2)
    steps = np.arange(-half, half + 0.5 * _STEP_PX, _STEP_PX)
    places = base[:, None] + steps[None, :, None] * normal  # (n, s, 2)
    levels = _sampled(grey, places)
    if levels is None:
        return None
    rise = np.maximum(np.diff(levels, axis=1), 0.0)
    between = 0.5 * (steps[1:] + steps[:-1])
    total = rise.sum(1)
    good = (levels[:, -1] - levels[:, 0]) >= _MIN_CONTRAST
    if good.mean() < _MIN_GOOD_SHARE:
        return None
    # Slopes of noise count as well: only those near the steepest place belong to the edge.
    offset = (rise * between).sum(1) / np.maximum(total, 1e-9)
    points = (base + offset[:, None] * normal)[good]
    return _line(points)


def _sampled(grey: np.ndarray, places: np.ndarray) -> np.ndarray | None:
    """Return bilinear samples at (..., 2) places, None if one lies outside."""
    x, y = places[..., 0] - 0.5, places[..., 1] - 0.5
    height, width = grey.shape
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    if left.min() < 0 or top.min() < 0 or left.max() >= width - 1 or top.max() >= height - 1:
        return None
    fx, fy = x - left, y - top
    a, b = grey[top, left].astype(np.float64), grey[top, left + 1]
    c, d = grey[top + 1, left], grey[top + 1, left + 1]
    return (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)


def _line(points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return point and normal of the line of least squares, without points far off it."""
    used = np.ones(len(points), bool)
    for _ in range(3):
        if used.sum() < 4:
            return None
        middle = points[used].mean(0)
        _, _, axes = np.linalg.svd(points[used] - middle, full_matrices=False)
        away = np.abs((points - middle) @ axes[1])
        used = away <= max(3.0 * 1.4826 * float(np.median(away)), 0.02)
    return middle, axes[1]


def _crossing(
    first: tuple[np.ndarray, np.ndarray] | None, second: tuple[np.ndarray, np.ndarray] | None
) -> np.ndarray | None:
    if first is None or second is None:
        return None
    normals = np.stack([first[1], second[1]])
    if abs(np.linalg.det(normals)) < 0.1:  # edges of a marker seen flat from the side
        return None
    return np.linalg.solve(normals, [first[1] @ first[0], second[1] @ second[0]])
