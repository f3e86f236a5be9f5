# SPDX-License-Identifier: GPL-3.0-or-later
"""Find the ground plane of a scene from its surface."""

from __future__ import annotations

import numpy as np

from .placement import COINCIDENT, Plane

LEVEL_DEG = 20.0
"""Largest tilt of ground faces: the up direction from cameras is off by a few degrees at most."""
BAND_SHARE = 0.02
"""Thickness of the plane's inlier band, as a share of the surface's extent."""
CLEAR_SHARE = 0.4
"""Share of the level, upward-facing area below the top that the plane must contain."""
LOW_SHARE = 0.4
"""The plane must lie in this lowest share of the heights: tops of objects are level as well."""
_ROUNDS = 4


def find_ground_plane(
    centers: np.ndarray, normals: np.ndarray, areas: np.ndarray, up: np.ndarray
) -> Plane | None:
    """Find the level plane that contains most of the low, upward-facing surface.

    Parameters
    ----------
    centers, normals : (f, 3) float64
        Centres and outward unit normals of a mesh's faces.
    areas : (f,) float64
    up : (3,) float64
        Unit vector, accurate to :data:`LEVEL_DEG`.

    Returns
    -------
    Plane or None
        None if no plane is distinct.
    """
    good = np.isfinite(centers).all(1) & np.isfinite(normals).all(1) & (areas > 0.0)
    centers, normals, areas = centers[good], normals[good], areas[good]
    level = normals @ up > np.cos(np.radians(LEVEL_DEG))
    if not level.any():
        return None
    middle = centers.mean(0)
    heights = (centers - middle) @ up  # (f,)
    extent = float(np.linalg.norm(np.ptp(centers, 0)))
    band = BAND_SHARE * extent
    if band <= COINCIDENT * float(np.abs(centers).max()):
        return None
    floor, ceiling = float(heights.min()), float(heights.max())
    limit = floor + LOW_SHARE * (ceiling - floor)
    level &= heights < ceiling - band  # a region closes the objects it cuts with a level top
    if not level.any():
        return None
    points, weights, low = centers[level] - middle, areas[level], heights[level] < limit
    start = _fullest_band(heights[level][low], weights[low], band)
    if start is None:
        return None
    normal, offset = up, start
    for _ in range(_ROUNDS):
        near = np.abs(points @ normal - offset) <= band  # (l,)
        if near.sum() < 3:
            return None
        mean = np.average(points[near], axis=0, weights=weights[near])
        spread = points[near] - mean
        values, axes = np.linalg.eigh((spread * weights[near, None]).T @ spread)
        if values[1] <= 1e-4 * values[2]:
            return None  # a strip: rotation about it is undetermined
        normal = axes[:, 0] if axes[:, 0] @ up >= 0.0 else -axes[:, 0]
        offset = float(mean @ normal)
    near = np.abs(points @ normal - offset) <= band
    if not near.any() or weights[near].sum() < CLEAR_SHARE * weights.sum():
        return None
    if normal @ up < np.cos(np.radians(LEVEL_DEG)):
        return None
    mean = np.average(points[near], axis=0, weights=weights[near])
    return Plane(middle + mean, normal)


def _fullest_band(heights: np.ndarray, weights: np.ndarray, width: float) -> float | None:
    """Return the middle of the window of ``width`` that holds the most weight."""
    if len(heights) == 0:
        return None
    order = np.argsort(heights, kind="stable")
    heights, total = heights[order], np.concatenate([[0.0], np.cumsum(weights[order])])
    last = np.searchsorted(heights, heights + width, side="right")  # (k,)
    first = int(np.argmax(total[last] - total[:-1]))
    return float(heights[first] + 0.5 * width)
