# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes in space, their inverse depths in photos, and their fit to points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...dataset.camera import Camera

LIKE_COSINE, LIKE_SHARE = 0.996, 0.012
"""Planes are one if their normals are so close and each passes the other's centre so closely,
relative to the distance of the camera (three times that for the weaker one's plane)."""

LEAST_INVERSE_DEPTH = 1e-9
"""Pixels where that of a plane is smaller do not show it: it is too far away, or lies behind."""

ANNEALING = (0.02, 0.014, 0.01, 0.007, 0.005, 0.0035, 0.0025, 0.0025)
"""Scales of the residuals, relative to the depth, of the steps of a robust fit."""


@dataclass(frozen=True)
class Plane:
    """All points X with ``normal @ X == offset``, and the points that speak for it."""

    normal: np.ndarray  # (3,) unit
    offset: float
    center: np.ndarray  # (3,) of the points
    points: np.ndarray  # (n, 3)
    weights: np.ndarray  # (n,) over squared depth, so that residuals count relative to it
    support: float
    """Sum of the weights of the known depths of segments."""
    views: frozenset[int]
    """Depth maps whose segments speak for it."""
    distance: float
    """Of the points from a camera that sees them."""

    def moved(self, normal: np.ndarray, offset: float) -> Plane:
        """Return the same evidence for another place."""
        return Plane(
            normal, offset, self.center, self.points, self.weights, self.support, self.views,
            self.distance,
        )  # fmt: skip


def image_plane(plane: Plane, camera: Camera) -> np.ndarray:
    """Return (3,) q: the plane's inverse depth is q @ (column, row, 1) at centres whole."""
    normal = camera.rotation @ plane.normal
    offset = plane.offset + normal @ camera.cam_from_world[:, 3]
    q = normal / (offset if abs(offset) > 1e-12 else 1e-12)
    a, b = q[0] / camera.fx, q[1] / camera.fy
    return np.array([a, b, q[2] - a * (camera.cx - 0.5) - b * (camera.cy - 0.5)])


def with_ones(pixels: np.ndarray) -> np.ndarray:
    """Return (n, 3) column, row, 1 of (n, 2) pixels."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1)


def lifted_pixels(camera: Camera, pixels: np.ndarray, inverse_depths: np.ndarray) -> np.ndarray:
    """Return the (n, 3) points, scene frame, of (n, 2) pixels with centres whole."""
    local = camera.rays_at(pixels + 0.5) / inverse_depths[:, None]
    return (local - camera.cam_from_world[:, 3]) @ camera.rotation


def fit_plane(
    points: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray]:  # fmt: skip
    """Return the normal, the offset and the centre of the plane of least squares."""
    center = np.average(points, axis=0, weights=weights)
    scaled = (points - center) * np.sqrt(weights)[:, None]
    normal = np.linalg.svd(scaled, full_matrices=False)[2][-1]
    return normal, float(normal @ center), center


def refined(plane: Plane) -> Plane:
    """Return the plane fitted to its points, those near it more and more alone."""
    normal, offset, center = plane.normal, plane.offset, plane.center
    for scale in ANNEALING:
        residual = np.abs(plane.points @ normal - offset) * np.sqrt(plane.weights)
        weights = plane.weights / (1.0 + (residual / scale) ** 2) ** 2
        normal, offset, center = fit_plane(plane.points, weights)
    return Plane(
        normal, offset, center, plane.points, plane.weights, plane.support, plane.views,
        plane.distance,
    )  # fmt: skip


def pooled(planes: Sequence[Plane], *, fit: bool = True) -> list[Plane]:
    """Return the planes with those that are the same as one; the best supported first.

    Parameters
    ----------
    fit : bool
        Fit each to the points of all that were put together.
    """
    ordered = sorted(planes, key=lambda p: -p.support)
    normals, centers = np.zeros((len(ordered), 3)), np.zeros((len(ordered), 3))
    offsets = np.zeros(len(ordered))
    groups: list[list[Plane]] = []
    for plane in ordered:
        count = len(groups)
        cosines = np.abs(normals[:count] @ plane.normal)
        passing = np.abs(normals[:count] @ plane.center - offsets[:count])
        passed = np.abs(centers[:count] @ plane.normal - plane.offset)
        near = LIKE_SHARE * plane.distance
        same = (cosines >= LIKE_COSINE) & (passing < near) & (passed < 3.0 * near)
        if same.any():
            groups[int(np.argmax(same))].append(plane)
        else:
            normals[count], centers[count] = plane.normal, plane.center
            offsets[count] = plane.offset
            groups.append([plane])
    joined = [_joined(group) for group in groups]
    return [refined(plane) for plane in joined] if fit else joined


def _joined(group: Sequence[Plane]) -> Plane:
    first = group[0]
    if len(group) == 1:
        return first
    return Plane(
        first.normal,
        first.offset,
        first.center,
        np.concatenate([plane.points for plane in group]),
        np.concatenate([plane.weights for plane in group]),
        sum(plane.support for plane in group),
        frozenset().union(*(plane.views for plane in group)),
        first.distance,
    )
