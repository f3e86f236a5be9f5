# SPDX-License-Identifier: GPL-3.0-or-later
"""Which cameras are compared with which by the multi-view terms (docs/method.md, section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ... import tolerances
from ...dataset.camera import Camera

_MOST_POINTS = 2000
"""Points that the overlap of two images is estimated from, spread over those given."""
_FEW_POINTS = 10
"""A camera that sees fewer of them says nothing about overlap: the other rules decide alone."""


@dataclass(frozen=True)
class NeighbourLimits:
    """What makes a camera a candidate; lengths in scene units.

    40 photos around an object are 16 to 28 degrees and 0.25 to 0.4 radii of the scene apart: with
    the method's 0.3 radii (:data:`FIXED_LIMITS`) 23 of 40 have no neighbour, with these none; on a
    capture of 50 to 80 photos every camera finds eight, the nearest of which are the method's. In a
    room, where axes differ by 28 to 101 degrees, 32 of 40 have none, with these none. Angles beyond
    30 degrees would add pairs that see a patch too differently, and no camera needs them.
    """

    max_angle_deg: float = 30.0
    """Between the optical axes."""
    min_distance: float = 0.002 * tolerances.SCENE_RADIUS
    """Between the centres: without a baseline, depth says nothing."""
    max_distance: float = 1.0 * tolerances.SCENE_RADIUS
    min_overlap: float = 0.3
    """Share of the sparse points in a camera's image that the other's image must hold too."""
    most: int = 8
    """Neighbours kept of each camera, the nearest."""


FIXED_LIMITS = NeighbourLimits(max_distance=0.3 * tolerances.SCENE_RADIUS, min_overlap=0.0)
"""The limits of docs/method.md, section 3.4, tuned on captures of hundreds of photos."""


def find_neighbours(
    cameras: Sequence[Camera],
    limits: NeighbourLimits | None = None,
    *,
    points: np.ndarray | None = None,
) -> list[np.ndarray]:
    """Return the cameras that each camera is compared with (docs/method.md, section 3.4).

    Candidates look in about the same direction from about the same place, and see part of the same
    sparse points. The nearest come first, ties by angle, then by index. One camera's choice does
    not depend on the others' choices.

    Parameters
    ----------
    cameras : sequence of Camera
        Scene frame.
    limits : NeighbourLimits, optional
    points : (n, 3) array, optional
        Sparse points, scene frame; without them overlap is not asked for.

    Returns
    -------
    list of (k,) int64
        Indices into ``cameras``, for each of them; empty where there is no candidate.
    """
    limits = limits or NeighbourLimits()
    if len(cameras) == 0:
        return []
    centers = np.stack([camera.center for camera in cameras])  # (c, 3)
    axes = np.stack([camera.forward for camera in cameras])  # (c, 3)
    seen = _seen_points(cameras, points)
    found = []
    for index in range(len(cameras)):
        distance = np.linalg.norm(centers - centers[index], axis=1)  # (c,)
        # The arc sine of half the chord keeps small angles exact, the arc cosine does not.
        chord = np.linalg.norm(axes - axes[index], axis=1)
        angle_deg = np.degrees(2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
        good = (angle_deg < limits.max_angle_deg) & (distance > limits.min_distance)
        good &= distance < limits.max_distance
        good[index] = False
        here = seen[index]
        if here.sum() >= _FEW_POINTS:
            good &= (seen & here).sum(1) >= limits.min_overlap * here.sum()
        candidates = np.flatnonzero(good)
        order = np.lexsort((candidates, angle_deg[candidates], distance[candidates]))
        found.append(candidates[order[: limits.most]])
    return found


def _seen_points(cameras: Sequence[Camera], points: np.ndarray | None) -> np.ndarray:
    """Return (c, n) bool: the image of a camera holds a point, whatever may stand before it."""
    if points is None or len(points) == 0:
        return np.zeros((len(cameras), 0), np.bool_)
    step = -(-len(points) // _MOST_POINTS)
    some = np.asarray(points, np.float64)[::step]
    seen = np.zeros((len(cameras), len(some)), np.bool_)
    for index, camera in enumerate(cameras):
        pixels, depth = camera.project(some)
        inside = (pixels >= 0.0).all(1) & (pixels <= [camera.width, camera.height]).all(1)
        seen[index] = inside & (depth > tolerances.NEAR_Z)
    return seen
