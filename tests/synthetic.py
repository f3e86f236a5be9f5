# SPDX-License-Identifier: GPL-3.0-or-later
"""A small scene with exact ground truth: a patterned ball on a floor under a dome, ray traced.

The photos, cameras (COLMAP text model) and sparse points come from closed forms, so a test can
compare a mesh with the true sphere. Beside it an image of waves, for what needs no scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.poses import look_at_pose

BALL_RADIUS = 1.0
FLOOR_Z = -1.0
FLOOR_RADIUS = 8.0
DOME_RADIUS = 9.0
DOME_SCALE = 0.2
"""The dome's pattern is this much coarser: a far background."""

SAMPLES = 2
"""Rays per pixel and direction, for edges without stairs."""


@dataclass(frozen=True)
class BallScene:
    """Where the scene was written and its exact cameras (world frame, Z-up)."""

    folder: Path
    cameras: tuple[Camera, ...]
    offset: np.ndarray
    scale: float


def look_at(
    center: np.ndarray, target: np.ndarray, name: str, width: int, height: int, focal_px: float
) -> Camera:
    """Return a camera at ``center`` that looks at ``target`` with world Z up."""
    pose = look_at_pose(center, target)
    return Camera(name, width, height, focal_px, focal_px, width / 2, height / 2, pose)


def _pattern(points: np.ndarray, seed: int) -> np.ndarray:
    """Return (n, 3) colours in [0.17, 0.88]: a sum of waves with a few periods over the scene."""
    generator = np.random.default_rng(seed)
    waves = generator.normal(size=(12, 3)) * 2.2  # (12, 3) radians per unit
    phases = generator.uniform(0, 2 * np.pi, size=(12, 3))
    amounts = generator.normal(size=(12, 3))
    angle = points @ waves.T  # (n, 12)
    value = (np.sin(angle[:, :, None] + phases[None]) * amounts[None]).sum(1)  # (n, 3)
    return 0.525 + 0.35 * np.tanh(0.4 * value)


def trace(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return (n, 3) colours of rays from one origin; (n, 3) directions need no unit length."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    outwards = unit @ origin
    reach = -outwards + np.sqrt(outwards**2 - (origin @ origin - DOME_RADIUS**2))
    color = _pattern((origin + reach[:, None] * unit) * DOME_SCALE, 4)
    below = np.where(unit[:, 2] < -1e-9, (FLOOR_Z - origin[2]) / unit[:, 2], np.inf)
    floor = origin + np.where(np.isfinite(below), below, 0.0)[:, None] * unit
    on_floor = np.isfinite(below) & (np.hypot(floor[:, 0], floor[:, 1]) < FLOOR_RADIUS)
    color[on_floor] = _pattern(floor[on_floor], 1)
    root = outwards**2 - (origin @ origin - BALL_RADIUS**2)
    hit = (root > 0) & (outwards < 0)
    ball = origin + (-outwards - np.sqrt(np.maximum(root, 0.0)))[:, None] * unit
    color[hit] = _pattern(ball[hit], 2)
    return color


def photograph(camera: Camera) -> np.ndarray:
    """Return the (h, w, 3) uint8 photo of the scene."""
    total = np.zeros((camera.height, camera.width, 3))
    for row in range(SAMPLES):
        for column in range(SAMPLES):
            shift_x, shift_y = (column + 0.5) / SAMPLES - 0.5, (row + 0.5) / SAMPLES - 0.5
            rays = camera.rays() + np.array([shift_x / camera.fx, shift_y / camera.fy, 0.0])
            world = rays.reshape(-1, 3) @ camera.rotation
            total += trace(camera.center, world).reshape(total.shape)
    return np.round(255 * total / SAMPLES**2).astype(np.uint8)


def write_ball_scene(
    folder: Path,
    *,
    photos: int = 30,
    width: int = 96,
    height: int = 80,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
) -> BallScene:
    """Write ``images/`` and ``sparse/0/*.txt``.

    Parameters
    ----------
    photos, width, height : int
        Two rings of cameras around the ball.
    offset, scale : world = scale * (scene below) + offset, to try large coordinates.
    """
    (folder / "images").mkdir(parents=True)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    shift = np.asarray(offset, np.float64)
    cameras = []
    image_lines, focal_px = [], 1.15 * width
    for index in range(photos):
        angle = 2 * np.pi * index / photos
        rise = 2.0 if index % 2 else 3.6
        center = np.array([4.0 * np.cos(angle), 4.0 * np.sin(angle), rise])
        local = look_at(center, np.array([0, 0, -0.2]), f"{index:03d}.png", width, height, focal_px)
        Image.fromarray(photograph(local)).save(folder / "images" / local.name)
        pose = local.cam_from_world.copy()
        pose[:, 3] = -(pose[:, :3] @ (scale * local.center + shift))
        cameras.append(
            Camera(local.name, width, height, focal_px, focal_px, width / 2, height / 2, pose)
        )
        quat, t = _quaternion(pose[:, :3]), pose[:, 3]
        numbers = " ".join(f"{v:.17g}" for v in (*quat, *t))
        image_lines += [f"{index + 1} {numbers} 1 {local.name}", ""]
    (model / "cameras.txt").write_text(
        f"1 PINHOLE {width} {height} {focal_px} {focal_px} {width / 2} {height / 2}\n"
    )
    (model / "images.txt").write_text("\n".join(image_lines) + "\n")
    points, colors = _surface_points(800)
    rows = [
        f"{i + 1} {x:.17g} {y:.17g} {z:.17g} {r} {g} {b} 0.5 1 0 2 0 3 0"
        for i, ((x, y, z), (r, g, b)) in enumerate(zip(scale * points + shift, colors, strict=True))
    ]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return BallScene(folder, tuple(cameras), shift, scale)


def _surface_points(count: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(3)
    ball = generator.normal(size=(count, 3))
    ball *= BALL_RADIUS / np.linalg.norm(ball, axis=1, keepdims=True)
    radius = FLOOR_RADIUS * np.sqrt(generator.uniform(size=count))
    angle = generator.uniform(0, 2 * np.pi, count)
    floor = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, FLOOR_Z)], 1)
    dome = generator.normal(size=(count, 3))
    dome[:, 2] = np.abs(dome[:, 2])
    dome *= DOME_RADIUS / np.linalg.norm(dome, axis=1, keepdims=True)
    points = np.concatenate([ball, floor, dome])
    colors = [_pattern(ball, 2), _pattern(floor, 1), _pattern(DOME_SCALE * dome, 4)]
    colors = np.concatenate(colors)
    return points, np.round(255 * colors).astype(int)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])


def textured(seed: int, height: int = 24, width: int = 31) -> np.ndarray:
    """Return an image with values in about [0.1, 0.7]."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 5.0
    phase = random.uniform(0, 6, 3)
    waves = np.sin(x[..., None] + phase) * np.cos(y[..., None] - phase)
    return 0.4 + 0.25 * waves + random.uniform(-0.05, 0.05, (height, width, 3))
