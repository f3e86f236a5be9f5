# SPDX-License-Identifier: GPL-3.0-or-later
"""Select neighbouring cameras for the multi-view terms (docs/method.md, section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ... import tolerances
from ...dataset.camera import Camera
from ...settings import TrainingSettings

_MOST_POINTS = 2000
"""Most points for estimating the overlap of two images, subsampled from those given."""
_FEW_POINTS = 10
"""The overlap criterion is skipped for cameras that see fewer of them."""


@dataclass(frozen=True)
class NeighbourLimits:
    """Criteria for candidate cameras; lengths in scene units.

    40 photos around an object are 16 to 28 degrees and 0.25 to 0.4 scene radii apart: with the
    method's 0.3 radii 23 of 40 have no neighbour, with these all have; on a
    capture of 50 to 80 photos every camera has eight, the nearest of which are the method's. In a
    room, where axes differ by 28 to 101 degrees, 32 of 40 have none, with these all have. Angles
    beyond 30 degrees would add pairs with too different views of a patch, and no camera needs them.
    """

    max_angle_deg: float = 30.0
    """Between the optical axes."""
    min_distance: float = 0.002 * tolerances.SCENE_RADIUS
    """Between the centres: without a baseline, depth is not constrained."""
    max_distance: float = TrainingSettings.neighbour_distance * tolerances.SCENE_RADIUS
    min_overlap: float = TrainingSettings.neighbour_overlap
    """Share of the sparse points in a camera's image that must also lie in the other's image."""
    most: int = 8
    """Most neighbours of each camera; the nearest are kept."""

    @classmethod
    def of_settings(cls, settings: TrainingSettings) -> NeighbourLimits:
        """Return the limits of a training's settings."""
        return cls(
            max_distance=settings.neighbour_distance * tolerances.SCENE_RADIUS,
            min_overlap=settings.neighbour_overlap,
        )


def find_neighbours(
    cameras: Sequence[Camera],
    limits: NeighbourLimits | None = None,
    *,
    points: np.ndarray | None = None,
) -> list[np.ndarray]:
    """Return the neighbours of each camera (docs/method.md, section 3.4).

    Candidates have a similar direction and position, and share part of the visible sparse points.
    Sorted by distance, then by angle, then by index. The neighbours of one camera do not depend on
    those of others.

    Parameters
    ----------
    cameras : sequence of Camera
        Scene frame.
    limits : NeighbourLimits, optional
    points : (n, 3) array, optional
        Sparse points, scene frame; without them the overlap criterion is skipped.

    Returns
    -------
    list of (k,) int64
        Indices into ``cameras``, for each camera; empty without candidates.
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
    """Return (c, n) bool: a point projects into the image of a camera, ignoring occlusion."""
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
