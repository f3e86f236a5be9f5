# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangulate a point that several posed photos show, some of them perhaps wrongly."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..camera import Camera

MIN_ANGLE_DEG = 1.5
"""Between two rays: at one degree, a pixel of error moves the point by 50 pixels along them."""
MAX_PAIRS = 300
"""Pairs of photos that are tried; of more, evenly many are left out."""
_ROUNDS = 12


@dataclass(frozen=True)
class TriangulatedPoint:
    """A point and how well the photos agree about it."""

    position: np.ndarray
    """(3,) float64, frame of the cameras."""
    covariance: np.ndarray
    """(3, 3) float64, from the stated error of a pixel position or the residuals, the larger."""
    used: np.ndarray
    """(n,) bool, observations that agree."""
    residuals_px: np.ndarray
    """(n,) distances of all observations."""


def triangulate(
    cameras: Sequence[Camera], pixels: np.ndarray, *, threshold_px: float, noise_px: float
) -> TriangulatedPoint | None:
    """Find the point that most observations agree with, then minimise their squared distances.

    Parameters
    ----------
    cameras : sequence of n Camera
    pixels : (n, 2) float64
        Where each camera shows the point.
    threshold_px : float
        Observations further away are wrong.
    noise_px : float
        Smallest error of an observation to reckon with.

    Returns
    -------
    TriangulatedPoint or None
        None if no two photos agree whose rays meet under :data:`MIN_ANGLE_DEG`.
    """
    pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
    centers = np.array([c.center for c in cameras]).reshape(-1, 3)
    rays = np.array(
        [c.rays_at(p[None])[0] @ c.rotation for c, p in zip(cameras, pixels, strict=True)]
    ).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    best: tuple[int, float, np.ndarray, np.ndarray] | None = None
    pairs = list(itertools.combinations(range(len(cameras)), 2))
    for i, j in pairs[:: max(1, math.ceil(len(pairs) / MAX_PAIRS))]:
        sine = np.linalg.norm(np.cross(rays[i], rays[j]))
        if sine < math.sin(math.radians(MIN_ANGLE_DEG)):
            continue
        point = _nearest(centers[[i, j]], rays[[i, j]])
        distances = _distances(cameras, pixels, point)
        used = distances <= threshold_px
        cost = float(np.minimum(distances, threshold_px).sum())
        if used.sum() >= 2 and (best is None or (-used.sum(), cost) < (-best[0], best[1])):
            best = int(used.sum()), cost, point, used
    if best is None:
        return None
    point, used = best[2], best[3]
    for _ in range(3):
        try:
            point, covariance = _least_squares(cameras, pixels, used, point, noise_px)
        except np.linalg.LinAlgError:  # the rays do not hold it along one direction
            return None
        distances = _distances(cameras, pixels, point)
        within = distances <= threshold_px
        if within.sum() < 2 or (within == used).all():
            break
        used = within
    if not np.isfinite(point).all() or not np.isfinite(covariance).all():
        return None
    return TriangulatedPoint(point, covariance, used, distances)


def _nearest(centers: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the point nearest to (k, 3) unit rays."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # (k, 3, 3)
    return np.linalg.solve(across.sum(0), np.einsum("kij,kj->i", across, centers))


def _distances(cameras: Sequence[Camera], pixels: np.ndarray, point: np.ndarray) -> np.ndarray:
    out = np.full(len(cameras), np.inf)
    for i, camera in enumerate(cameras):
        shown, depth = camera.project(point[None])
        if depth[0] > 0.0:
            out[i] = np.linalg.norm(shown[0] - pixels[i])
    return out


def _least_squares(
    cameras: Sequence[Camera],
    pixels: np.ndarray,
    used: np.ndarray,
    point: np.ndarray,
    noise_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the point of least squared pixel distances, and its covariance."""
    chosen = np.flatnonzero(used)
    rotations = np.array([cameras[i].rotation for i in chosen])  # (k, 3, 3)
    translations = np.array([cameras[i].cam_from_world[:, 3] for i in chosen])
    focal = np.array([(cameras[i].fx, cameras[i].fy) for i in chosen])
    middle = np.array([(cameras[i].cx, cameras[i].cy) for i in chosen])
    normal, squared = np.eye(3), 0.0
    for _ in range(_ROUNDS):
        local = np.einsum("kij,j->ki", rotations, point) + translations
        depth = local[:, 2:]
        slopes = local[:, :2] / depth
        errors = focal * slopes + middle - pixels[chosen]  # (k, 2)
        # d(f x / z) = f / z (dx - x / z dz)
        turned = rotations[:, :2] - slopes[:, :, None] * rotations[:, 2:]  # (k, 2, 3)
        jacobian = (focal / depth)[:, :, None] * turned
        normal = np.einsum("kij,kil->jl", jacobian, jacobian)
        step = np.linalg.solve(normal, np.einsum("kij,ki->j", jacobian, errors))
        point = point - step
        squared = float((errors**2).sum())
        if np.linalg.norm(step) <= 1e-12 * (1.0 + np.linalg.norm(point)):
            break
    freedom = max(2 * len(chosen) - 3, 1)
    variance = max(squared / freedom, noise_px**2)
    return point, variance * np.linalg.inv(normal)
