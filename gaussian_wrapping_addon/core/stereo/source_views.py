# SPDX-License-Identifier: GPL-3.0-or-later
"""Which photos each photo is matched with (docs/method.md, section 11.5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .. import tolerances
from ..dataset.camera import Camera

MOST_SOURCES = 8
"""Sources of a photo; one bit each in a byte. With five, a fifth fewer background pixels are
confirmed."""

BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG = 12.0, 5.0, 12.0
"""Angle between two rays to a point at which matching is best, and how fast it gets worse."""

LEAST_GAIN = 1e-3
"""Least share of the points for which a source is of use."""

_MOST_POINTS = 1500
"""Points that decide, subsampled from those given."""


def source_views(cameras: Sequence[Camera], points: np.ndarray) -> list[np.ndarray]:
    """Choose the sources of each photo, greedily, best first.

    A point in both images counts by the angle between its two rays and by the likeness of its two
    scales, the less the more sources chosen before hold it.

    Parameters
    ----------
    cameras : sequence of Camera
    points : (n, 3) float64
        Sparse points in the frame of the cameras.

    Returns
    -------
    list of (k,) int64
        Indices of at most :data:`MOST_SOURCES` other cameras, for each camera; empty where none
        shares points with it.
    """
    count = len(cameras)
    points = points[:: max(1, -(-len(points) // _MOST_POINTS))]
    if len(points) == 0:
        return [np.zeros(0, np.int64) for _ in cameras]
    inside = np.zeros((count, len(points)), bool)
    scale = np.ones((count, len(points)))  # scene units per pixel
    for i, camera in enumerate(cameras):
        inside[i], depth = in_image(camera, points)
        scale[i] = np.maximum(depth, tolerances.NEAR_Z) / camera.fx
    centers = np.stack([camera.center for camera in cameras])  # (c, 3)
    rays = points[None] - centers[:, None]  # (c, n, 3)
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    return [_sources_of(i, inside, scale, rays) for i in range(count)]


def in_image(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tell which points (n, 3) project into the image, and return their z-depths (n,)."""
    pixels, depth = camera.project(points)
    size = np.array([camera.width, camera.height])
    return (depth > tolerances.NEAR_Z) & (pixels >= 0).all(1) & (pixels < size).all(1), depth


def _sources_of(view: int, inside: np.ndarray, scale: np.ndarray, rays: np.ndarray) -> np.ndarray:
    seen = np.flatnonzero(inside[view])
    both = inside[:, seen]  # (c, m)
    cosine = np.einsum("pi,cpi->cp", rays[view, seen], rays[:, seen])
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    width_deg = np.where(angle_deg < BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG)
    likeness = np.minimum(scale[view, seen] / scale[:, seen], scale[:, seen] / scale[view, seen])
    gain = both * likeness * np.exp(-0.5 * ((angle_deg - BEST_ANGLE_DEG) / width_deg) ** 2)
    gain[view] = 0.0
    covered = np.zeros(len(seen))
    chosen: list[int] = []
    for _ in range(min(MOST_SOURCES, len(inside) - 1)):
        score = (gain / (1.0 + covered)).sum(1)
        score[chosen] = 0.0
        best = int(score.argmax())
        if score[best] <= LEAST_GAIN * max(1, len(seen)):
            break
        chosen.append(best)
        covered += gain[best]
    return np.array(chosen, np.int64)
