# SPDX-License-Identifier: GPL-3.0-or-later
"""Local spacing of surface points: no finer than the photos resolve, with bounded gradation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...dataset.camera import Camera
from ...mesh.surface_sampling import EDGE_PER_RADIUS

EDGE_PER_PIXEL = 0.5
"""Shortest edge, in pixels of the nearest camera. The finest pattern in a photo has a period of two
pixels; four vertices represent it."""

GRADING = 0.4
"""Edges lengthen by at most this share of the distance, so that triangles stay well shaped."""

LONGEST_SHARE = 8.0
"""Edges are lengthened to at most this many nominal ones, however far the nearest camera is."""


def footprints(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the smallest pixel footprint over the cameras at each point, (n,).

    0 where no camera sees the point.
    """
    finest = np.full(len(points), np.inf)
    for camera in cameras:
        pixel, depth = camera.project(points)
        inside = (depth > 0) & (pixel >= 0).all(1)
        inside &= (pixel[:, 0] <= camera.width) & (pixel[:, 1] <= camera.height)
        size = depth / max(camera.fx, camera.fy)
        finest = np.where(inside, np.minimum(finest, size), finest)
    return np.where(np.isfinite(finest), finest, 0.0)


def resolved_edges(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the shortest edge that the photos resolve at each point, (n,); 0 where unseen."""
    return EDGE_PER_PIXEL * footprints(points, cameras)


@dataclass(frozen=True)
class Spacing:
    """Local thinning radii, sampled at points of the surface."""

    points: np.ndarray
    """(n, 3) float64."""
    radii: np.ndarray
    """(n,) float64."""
    nominal: float
    """Radius where the photos do not limit it: the smallest one."""
    limited: float
    """Share of the area where the photos limit the radius."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.points))

    @classmethod
    def uniform(cls, radius: float) -> Spacing:
        """Return the same spacing everywhere."""
        return cls(np.zeros((1, 3)), np.array([radius]), radius, 0.0)

    def at(self, where: np.ndarray, threads: int = 1) -> np.ndarray:
        """Return the radius at (m, 3) points; it grows with the distance to samples."""
        if len(self.points) == 1:
            return np.full(len(where), self.radii[0])
        k = min(4, len(self.points))
        distance, index = self._tree.query(where, k=k, workers=threads)  # type: ignore[attr-defined]
        weight = 1.0 / (distance**2 + (0.5 * self.radii[index]) ** 2)
        mean = (weight * self.radii[index]).sum(1) / weight.sum(1)
        return mean + GRADING / EDGE_PER_RADIUS * np.maximum(distance[:, 0] - mean, 0.0)


def footprint_spacing(points: np.ndarray, cameras: Sequence[Camera], radius: float) -> Spacing:
    """Return a radius everywhere, larger where the photos resolve no edges so short.

    Parameters
    ----------
    points : (n, 3) float64
        Spread evenly over the surface.
    cameras : sequence of Camera
    radius : float
        Thinning radius of the nominal edge length.
    """
    edge = EDGE_PER_RADIUS * radius
    resolved = np.minimum(resolved_edges(points, cameras), LONGEST_SHARE * edge)
    limited = float(np.mean(resolved > edge)) if len(points) else 0.0
    if limited == 0.0:
        return Spacing.uniform(radius)
    near = cKDTree(points).query(points, k=min(8, len(points)))
    edges = graded(np.maximum(resolved, edge), *near)
    return Spacing(points, edges / EDGE_PER_RADIUS, radius, limited)


def graded(edges: np.ndarray, distance: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Shorten edges until neighbours differ by at most :data:`GRADING` times their distance.

    Parameters
    ----------
    edges : (n,) float64
    distance, index : (n, k)
        Nearest neighbours of each point.
    """
    result = edges
    step = GRADING * distance
    while True:
        # In both directions: nearest-neighbour relations are not symmetric.
        lower = np.minimum(result, (result[index] + step).min(1))
        np.minimum.at(lower, index, lower[:, None] + step)
        if (lower > 0.99 * result).all():
            return lower
        result = lower
