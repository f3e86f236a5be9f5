# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse points and poses as a solver returns them: gaps, outliers, noise along the depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.dataset.camera import Camera

from ..scenes.sparse_points import MIN_TRACK, SparsePoints, sparse_points
from ..scenes.visibility import RayScene
from .content import Photography

POINTS = 5000
"""At most so many are followed."""
_WINDOW_PX = 7
"""The steepest slope in a window of this side decides whether a place has texture."""
_DEPTHS = (0.5, 2.5)
"""Outliers lie on a ray of theirs at such multiples of the true depth."""


def found_points(
    rays: RayScene,
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    shot: Photography,
    seed: int,
) -> SparsePoints:
    """Return the sparse points of a scene.

    Those of :func:`~benchmarks.scenes.sparse_points.sparse_points` without what lies where a photo
    has no texture, moved further along what their tracks do not determine, and some anywhere on
    one of their rays.

    Parameters
    ----------
    photos : sequence of (h, w, 3) uint8
    """
    random = np.random.default_rng([seed, 4])
    sparse = _textured(sparse_points(rays, cameras, photos, seed, POINTS), photos, shot)
    moved = sparse.points + shot.point_noise * _uncertain(sparse, cameras, random)
    wrong = random.random(len(moved)) < shot.outliers
    first = np.searchsorted(sparse.point_ids, np.flatnonzero(wrong))
    centers = np.array([cameras[k].center for k in sparse.camera_ids[first]]).reshape(-1, 3)
    stretch = random.uniform(*_DEPTHS, (len(first), 1))
    moved[wrong] = centers + stretch * (moved[wrong] - centers)
    errors = sparse.errors_px * np.hypot(1.0, 0.5 * shot.point_noise)
    errors[wrong] *= random.uniform(1.5, 4.0, len(first))
    return replace(sparse, points=moved, errors_px=errors)


def _textured(
    sparse: SparsePoints, photos: Sequence[np.ndarray], shot: Photography
) -> SparsePoints:
    """Return the observations where the photo has a slope, and the points that keep enough."""
    kept = np.zeros(len(sparse.point_ids), bool)
    for index, photo in enumerate(photos):
        gray = photo.astype(np.float64).mean(2)
        padded = np.pad(gray, 1, mode="edge")
        h, w = gray.shape
        gray = sum(padded[i : i + h, j : j + w] for i in range(3) for j in range(3)) / 9.0
        slope = maximum_filter(np.hypot(*np.gradient(gray)), _WINDOW_PX)
        mine = np.flatnonzero(sparse.camera_ids == index)
        at = sparse.pixels[mine].astype(int)
        kept[mine] = (
            slope[np.clip(at[:, 1], 0, h - 1), np.clip(at[:, 0], 0, w - 1)] > shot.weak_texture
        )
    length = np.bincount(sparse.point_ids[kept], minlength=len(sparse.points))
    stays = length >= MIN_TRACK
    kept &= stays[sparse.point_ids]
    number = np.cumsum(stays) - 1
    return SparsePoints(
        sparse.points[stays],
        sparse.colors[stays],
        sparse.errors_px[stays],
        number[sparse.point_ids[kept]],
        sparse.camera_ids[kept],
        sparse.pixels[kept],
    )


def _uncertain(
    sparse: SparsePoints, cameras: Sequence[Camera], random: np.random.Generator
) -> np.ndarray:
    """Draw shifts (n, 3) from what half a pixel in each observation leaves open."""
    information = np.zeros((len(sparse.points), 3, 3))
    for index, camera in enumerate(cameras):
        ids = sparse.point_ids[sparse.camera_ids == index]
        way = sparse.points[ids] - camera.center
        away = np.linalg.norm(way, axis=1)
        way /= away[:, None]
        across = np.eye(3) - way[:, :, None] * way[:, None]
        weight = (camera.fx / (0.5 * away)) ** 2
        np.add.at(information, ids, weight[:, None, None] * across)
    values, axes = np.linalg.eigh(information)
    steps = random.normal(size=values.shape) / np.sqrt(np.maximum(values, 1e-12))
    return np.einsum("nij,nj->ni", axes, steps)


def disturbed_poses(
    cameras: Sequence[Camera], noise_px: float, distance: float, seed: int
) -> list[Camera]:
    """Return the cameras turned and moved, each so that things shift by ``noise_px`` a axis.

    Parameters
    ----------
    distance : float
        Typical distance of what the photos show.
    """
    random = np.random.default_rng([seed, 5])
    result = []
    for camera in cameras:
        # Half of the variance by turning, half by moving.
        angle = noise_px / camera.fx / np.sqrt(2.0)
        turn = Rotation.from_rotvec(angle * random.normal(size=3)).as_matrix()
        center = camera.center + angle * distance * random.normal(size=3)
        rotation = turn @ camera.rotation
        pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
        result.append(replace(camera, cam_from_world=pose))
    return result
