# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of the ball, the floor and the dome in memory, and their exact depths and normals."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthMap, estimate_depth_maps
from tests.core.training.small_scene import PhotosInMemory
from tests.synthetic import (
    BALL_RADIUS,
    DOME_RADIUS,
    FLOOR_RADIUS,
    FLOOR_Z,
    look_at,
    photograph,
    trace,
)

WIDTH, HEIGHT = 128, 96
COUNT = 14
ARC_DEG = 150.0
"""Cameras stand on an arc: neighbours about 12 degrees apart."""


def arc_cameras(count: int = COUNT) -> list[Camera]:
    """Return cameras on an arc around the ball, at two heights."""
    cameras = []
    for i, angle in enumerate(np.radians(np.linspace(0.0, ARC_DEG, count))):
        center = np.array([4.0 * np.cos(angle), 4.0 * np.sin(angle), 2.4 if i % 2 else 1.8])
        target = np.array([0.0, 0.0, -0.2])
        cameras.append(look_at(center, target, f"{i:03d}.png", WIDTH, HEIGHT, 1.15 * WIDTH))
    return cameras


@functools.cache
def ball_scene() -> tuple[Scene, PhotosInMemory]:
    """Return the scene with exact sparse points on all surfaces, and its photos."""
    cameras = arc_cameras()
    random = np.random.default_rng(5)
    parts = [random.permutation(surface_points(camera).reshape(-1, 3))[:60] for camera in cameras]
    points = np.concatenate(parts)
    eye = np.array([0.0, 0.0, 3.0])
    colors = np.round(255 * trace(eye, points - eye))
    views = tuple(View(camera, Path(camera.name)) for camera in cameras)
    scene = Scene(views, points, colors.astype(np.uint8), Similarity())
    return scene, PhotosInMemory(scene, [photograph(camera) for camera in cameras])


SIDE_PX = 640
"""Longest side at which photos are matched: they are smaller."""


@functools.cache
def ball_maps() -> tuple[DepthMap, ...]:
    """Return the depth maps of all photos."""
    scene, photos = ball_scene()
    views = range(len(scene.views))
    return tuple(
        estimate_depth_maps(photos, views, scene.points, Progress(), side_px=SIDE_PX, threads=1)
    )


def with_photos(
    photos: PhotosInMemory, changed: Sequence[np.ndarray], masks: list | None = None
) -> PhotosInMemory:
    """Return other photos of the same scene."""
    return PhotosInMemory(photos.scene, list(changed), masks)


def true_depth(camera: Camera) -> np.ndarray:
    """Return the (h, w) z-depth of the scene at the centres of the pixels."""
    rays = camera.rays().reshape(-1, 3) @ camera.rotation  # z-depth 1 each
    origin = camera.center
    square, along = (rays**2).sum(1), rays @ origin
    depth = _far_root(square, along, origin, DOME_RADIUS)
    with np.errstate(divide="ignore"):
        floor = (FLOOR_Z - origin[2]) / rays[:, 2]
    place = origin + np.where(np.isfinite(floor), floor, 0.0)[:, None] * rays
    on_floor = (floor > 0) & (np.hypot(place[:, 0], place[:, 1]) < FLOOR_RADIUS)
    depth = np.where(on_floor, floor, depth)
    root = along**2 - square * (origin @ origin - BALL_RADIUS**2)
    near = (-along - np.sqrt(np.maximum(root, 0.0))) / square
    depth = np.where((root > 0) & (along < 0), near, depth)
    return depth.reshape(camera.height, camera.width)


def surface_points(camera: Camera) -> np.ndarray:
    """Return the (h, w, 3) points of the scene that the pixels show."""
    local = camera.rays() * true_depth(camera)[..., None] - camera.cam_from_world[:, 3]
    return local @ camera.rotation


def true_normals(points: np.ndarray) -> np.ndarray:
    """Return the (n, 3) unit normals of the nearest surface, towards the inside of the dome."""
    distance = np.abs(surface_distances(points))  # (3, n)
    radial = points / np.linalg.norm(points, axis=1, keepdims=True)
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    return np.stack([radial, up, -radial])[distance.argmin(0), np.arange(len(points))]


def surface_distances(points: np.ndarray) -> np.ndarray:
    """Return the (3, n) signed distances from ball, floor and dome."""
    radius = np.linalg.norm(points, axis=1)
    return np.stack([radius - BALL_RADIUS, points[:, 2] - FLOOR_Z, radius - DOME_RADIUS])


def surface_distance(points: np.ndarray) -> np.ndarray:
    """Return the (n,) distances from the nearest surface."""
    return np.abs(surface_distances(points)).min(0)


def exact_map(camera: Camera, **changes: object) -> DepthMap:
    """Return a depth map of the truth, confirmed everywhere."""
    shape = (camera.height, camera.width)
    points = surface_points(camera)
    found = DepthMap(
        camera=camera,
        depth=true_depth(camera).astype(np.float32),
        normal=true_normals(points.reshape(-1, 3)).reshape(*shape, 3).astype(np.float32),
        confidence=np.ones(shape, np.float32),
        agreeing=np.full(shape, 4, np.uint8),
        cost=np.zeros(shape, np.float32),
        color=photograph(camera),
        mask=None,
    )
    return dataclasses.replace(found, **changes)  # type: ignore[arg-type]


def _far_root(
    square: np.ndarray, along: np.ndarray, origin: np.ndarray, radius: float
) -> np.ndarray:
    return (-along + np.sqrt(along**2 - square * (origin @ origin - radius**2))) / square
