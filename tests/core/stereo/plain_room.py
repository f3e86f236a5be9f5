# SPDX-License-Identifier: GPL-3.0-or-later
"""A textured floor before a plain wall with two pictures, under a plain sky; all in closed form."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthMap
from tests.synthetic import look_at

WIDTH, HEIGHT = 160, 120
COUNT = 8
WALL_Y, WALL_TOP = 3.0, 2.2
PICTURES = ((-1.6, -0.7, 0.7, 1.3), (0.6, 1.5, 1.2, 1.9))
"""Least and largest x, least and largest z."""
FLOOR, WALL, PICTURE, SKY = range(4)
FAINT_LEVELS = 1.2
"""Amplitude of the texture of the wall, grey levels: steps of neighbours are below one level."""
BAND_PX = 3
"""Width of the band of the wall beside textured things whose depth is confirmed."""


@functools.cache
def cameras() -> tuple[Camera, ...]:
    """Return cameras in an arc before the wall."""
    found = []
    for i, x in enumerate(np.linspace(-1.6, 1.6, COUNT)):
        center = np.array([x, -0.6 + 0.25 * (i % 2), 1.2 + 0.2 * (i % 3)])
        target = np.array([0.2 * x, WALL_Y, 1.2])
        found.append(look_at(center, target, f"{i}.png", WIDTH, HEIGHT, 0.8 * WIDTH))
    return tuple(found)


def traced(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the (h, w) z-depth, infinite in the sky, the part, and the (h, w, 3) points."""
    rays = camera.rays() @ camera.rotation  # z-depth 1 each
    center = camera.center
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(rays[..., 2] < 0, -center[2] / rays[..., 2], np.inf)
        wall = np.where(rays[..., 1] > 0, (WALL_Y - center[1]) / rays[..., 1], np.inf)
        wall = np.where(center[2] + wall * rays[..., 2] > WALL_TOP, np.inf, wall)
    depth = np.minimum(floor, wall)
    finite = np.isfinite(depth)
    points = center + rays * np.where(finite, depth, 1.0)[..., None]
    part = np.where(finite, np.where(wall < floor, WALL, FLOOR), SKY)
    x, z = points[..., 0], points[..., 2]
    for left, right, low, high in PICTURES:
        within = (x > left) & (x < right) & (z > low) & (z < high)
        part = np.where((part == WALL) & within, PICTURE, part)
    return depth, part, points


def photo(camera: Camera, gain: float = 1.0) -> np.ndarray:
    """Return the (h, w, 3) uint8 photo."""
    _, part, points = traced(camera)
    x, z = points[..., 0], points[..., 2]
    faint = np.sin(11 * x + 1.0) * np.sin(9 * z + 0.3 * x) + np.sin(17 * x - 13 * z)
    strong = 50 * np.sign(np.sin(9.0 * x) * np.sin(9.0 * (points[..., 1] + z)))
    grey = np.select(
        [part == FLOOR, part == WALL, part == PICTURE],
        [110 + strong, 140 + FAINT_LEVELS * faint, 100 + strong],
        215.0,
    )
    return np.clip(grey[..., None] * gain * np.array([1.0, 0.97, 0.93]) + 0.5, 0, 255).astype(
        np.uint8
    )


def near(pixels: np.ndarray, reach: int) -> np.ndarray:
    """Return the pixels within some rows and columns of others."""
    found = pixels.copy()
    for y in range(-reach, reach + 1):
        for x in range(-reach, reach + 1):
            found |= np.roll(pixels, (y, x), (0, 1))
    return found


def depth_map(camera: Camera, gain: float = 1.0) -> DepthMap:
    """Return what stereo finds: exact at texture and right beside it, nonsense elsewhere."""
    depth, part, _ = traced(camera)
    textured = (part == FLOOR) | (part == PICTURE)
    confirmed = textured | ((part == WALL) & near(textured, BAND_PX))
    normal = np.where((part == FLOOR)[..., None], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0])
    nonsense = np.full_like(depth, 1.7)
    return DepthMap(
        camera,
        np.where(confirmed, depth, nonsense).astype(np.float32),
        normal.astype(np.float32),
        np.where(confirmed, 0.8, 0.0).astype(np.float32),
        np.where(confirmed, 4, 0).astype(np.uint8),
        np.where(confirmed, 0.1, 1.0).astype(np.float32),
        photo(camera, gain),
        None,
    )


@functools.cache
def depth_maps() -> tuple[DepthMap, ...]:
    """Return the depth maps of all photos."""
    return tuple(depth_map(camera) for camera in cameras())


def noisy_maps(noise: float) -> list[DepthMap]:
    """Return the depth maps with noise of a standard deviation, grey levels, in the photos."""
    random = np.random.default_rng(11)
    return [
        with_noise(clean, noise * random.normal(size=clean.color.shape)) for clean in depth_maps()
    ]


def with_noise(clean: DepthMap, noise: np.ndarray) -> DepthMap:
    """Return a depth map whose photo has noise added, grey levels that broadcast to (h, w, 3)."""
    color = np.clip(np.rint(clean.color + noise), 0, 255).astype(np.uint8)
    return dataclasses.replace(clean, color=color)


@functools.cache
def sparse_points() -> np.ndarray:
    """Return points on the floor and the pictures."""
    random = np.random.default_rng(3)
    parts = []
    for camera in cameras():
        _, part, points = traced(camera)
        parts.append(random.permutation(points[(part == FLOOR) | (part == PICTURE)])[:20])
    return np.concatenate(parts)
