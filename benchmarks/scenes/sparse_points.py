# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse points as a pose solver would return them: noisy observations, short tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera

from .visibility import RayScene

NOISE_PX = 0.5
"""Standard deviation of an observation, per axis."""

SHARED_COSINE = np.cos(np.radians(35.0))
"""A keypoint is found again by cameras that see it from within this angle only."""

FOUND_SHARE = 0.75
"""Of the cameras that could find a keypoint again, this share does."""

MIN_TRACK = 3


@dataclass(frozen=True)
class SparsePoints:
    """Points with colours and tracks."""

    points: np.ndarray
    """(n, 3) float64."""
    colors: np.ndarray
    """(n, 3) uint8."""
    errors_px: np.ndarray
    """(n,) mean reprojection error."""
    point_ids: np.ndarray
    """(o,) int64 point of each observation, sorted."""
    camera_ids: np.ndarray
    """(o,) int64 camera of each observation."""
    pixels: np.ndarray
    """(o, 2) float64 position of each observation."""


def _keypoints(photo: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Return (n, 2) distinct pixels, mostly where the photo has structure."""
    gray = photo.astype(np.float64).mean(2)
    # Averaged over 3 x 3 pixels first, so that the grain of the photo is no structure.
    padded = np.pad(gray, 1, mode="edge")
    h, w = gray.shape
    gray = sum(padded[i : i + h, j : j + w] for i in range(3) for j in range(3)) / 9.0
    dy, dx = np.gradient(gray)
    weight = (dx**2 + dy**2 + 0.02).reshape(-1) ** 0.5
    border = np.zeros(gray.shape, bool)
    border[2:-2, 2:-2] = True
    weight *= border.reshape(-1)
    chosen = random.choice(weight.size, min(count, int(border.sum())), False, weight / weight.sum())
    return np.stack([chosen % w, chosen // w], 1)


def sparse_points(
    rays: RayScene,
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    seed: int,
    count: int = 3000,
) -> SparsePoints:
    """Find keypoints in the photos, follow them through the cameras, and triangulate.

    Observations have Gaussian noise; the points are one Gauss-Newton step from the truth to the
    smallest reprojection error, so their noise is that of a bundle adjustment with known cameras.

    Parameters
    ----------
    photos : sequence of (h, w, 3) uint8
    """
    random = np.random.default_rng([seed, 2])
    points, normals, colors, origin = _candidates(rays, cameras, photos, count, random)
    found = np.zeros((len(points), len(cameras)), bool)
    towards = np.array([camera.center for camera in cameras])[origin] - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    for index, camera in enumerate(cameras):
        way = camera.center - points
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        near = np.einsum("ij,ij->i", way, towards) > SHARED_COSINE
        lucky = random.random(len(points)) < FOUND_SHARE
        found[:, index] = rays.sees(camera, points, normals) & near & (lucky | (origin == index))
    kept = np.flatnonzero(found.sum(1) >= MIN_TRACK)
    kept = np.sort(random.permutation(kept)[:count])
    points, colors, found = points[kept], colors[kept], found[kept]
    point_ids, camera_ids = np.nonzero(found)
    noise = random.normal(size=(len(point_ids), 2)) * NOISE_PX
    return _triangulated(points, colors, point_ids, camera_ids, noise, cameras)


def _candidates(
    rays: RayScene,
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    count: int,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return surface points, normals, colours and the camera of keypoints of every photo."""
    each = 2 * count // len(cameras) + 1
    rows = []
    for index, (camera, photo) in enumerate(zip(cameras, photos, strict=True)):
        pixels = _keypoints(photo, each, random)
        directions = camera.rays_at(pixels + 0.5) @ camera.rotation
        origins = np.broadcast_to(camera.center, directions.shape)
        distance, face = rays.first_hits(origins, directions)
        hit = np.isfinite(distance)
        points = origins[hit] + distance[hit, None] * directions[hit]
        normals = rays.normals[face[hit]]
        facing = np.einsum("ij,ij->i", normals, directions[hit]) < 0
        normals = np.where(facing[:, None], normals, -normals)
        colors = photo[pixels[hit, 1], pixels[hit, 0]]
        rows.append((points, normals, colors, np.full(len(points), index)))
    return tuple(np.concatenate(column) for column in zip(*rows, strict=True))  # type: ignore[return-value]


def _triangulated(
    points: np.ndarray,
    colors: np.ndarray,
    point_ids: np.ndarray,
    camera_ids: np.ndarray,
    noise: np.ndarray,
    cameras: Sequence[Camera],
) -> SparsePoints:
    exact = np.empty((len(point_ids), 2))
    slope = np.empty((len(point_ids), 2, 3))
    for index, camera in enumerate(cameras):
        mine = camera_ids == index
        local = camera.to_camera(points[point_ids[mine]])
        exact[mine] = camera.project(points[point_ids[mine]])[0]
        x, y, z = local.T
        zero = np.zeros_like(z)
        inner = np.stack(
            [np.stack([camera.fx / z, zero, -camera.fx * x / z**2], 1),
             np.stack([zero, camera.fy / z, -camera.fy * y / z**2], 1)], 1
        )  # fmt: skip
        slope[mine] = inner @ camera.rotation
    normal = np.zeros((len(points), 3, 3))
    right = np.zeros((len(points), 3))
    np.add.at(normal, point_ids, np.einsum("oki,okj->oij", slope, slope))
    np.add.at(right, point_ids, np.einsum("oki,ok->oi", slope, noise))
    moved = np.linalg.solve(normal, right[..., None])[..., 0]
    residual = np.linalg.norm(noise - np.einsum("oki,oi->ok", slope, moved[point_ids]), axis=1)
    length = np.bincount(point_ids, minlength=len(points))
    errors = np.bincount(point_ids, residual, len(points)) / np.maximum(length, 1)
    return SparsePoints(points + moved, colors, errors, point_ids, camera_ids, exact + noise)
