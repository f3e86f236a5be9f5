# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a table with boxes and printed markers, by a ray caster over textured quads.

World units are not metres: one metre is :data:`UNITS_PER_METRE` of them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.poses import look_at_pose

UNITS_PER_METRE = 3.7
DICTIONARY = "4x4_50"
SIDE_M = 0.12
MARGIN = 0.25
"""White around a marker, over its side."""
SAMPLES = 3
"""Rays of a pixel along each direction."""


@dataclass(frozen=True)
class Quad:
    """A textured parallelogram."""

    corner: np.ndarray
    """(3,) of the texture's first texel."""
    right: np.ndarray
    down: np.ndarray
    """(3,) along the texture's rows and columns, of the whole length."""
    texture: np.ndarray
    """(h, w) float32, 0 to 255."""


def marker_image(number: int) -> np.ndarray:
    """Return a marker with its white margin, (n, n) float32."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    side = 6 * 24
    black = cv2.aruco.generateImageMarker(dictionary, number, side)
    margin = round(MARGIN * side)
    return np.pad(black.astype(np.float32), margin, constant_values=235.0).clip(12.0, 235.0)


def noise(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Return a texture with detail of all sizes, (height, width) float32."""
    total = np.zeros((height, width))
    size = 4
    while size <= max(width, height):
        small = rng.uniform(-1.0, 1.0, (max(2, height * size // max(width, height)) + 1, size + 1))
        image = Image.fromarray(small.astype(np.float32)).resize((width, height), 3)
        total += np.asarray(image) / size**0.35
        size *= 2
    total = (total - total.mean()) / total.std()
    return np.clip(128.0 + 48.0 * total, 5.0, 250.0).astype(np.float32)


def table_scene() -> list[Quad]:
    """Return ground, boxes and markers, in world units, z up."""
    rng = np.random.default_rng(0)
    x, y, z = np.eye(3)
    u = UNITS_PER_METRE
    corner = u * np.array([-2.0, 2.0, 0.0])
    quads = [Quad(corner, 4 * u * x, -4 * u * y, noise(rng, 1500, 1500))]
    spots: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for angle, size in ((0.3, 0.34), (2.2, 0.28), (4.4, 0.4)):
        a, b = np.cos(angle) * x + np.sin(angle) * y, -np.sin(angle) * x + np.cos(angle) * y
        middle, h = 0.55 * a, size
        for out, along in ((a, b), (b, -a), (-a, -b), (-b, a)):
            top_left = middle + 0.5 * size * out - 0.5 * size * along + h * z
            quads.append(Quad(u * top_left, u * size * along, -u * h * z, noise(rng, 240, 240)))
        corner = middle - 0.5 * size * a + 0.5 * size * b + h * z
        quads.append(Quad(u * corner, u * size * a, -u * size * b, noise(rng, 240, 240)))
        spots.append((middle + (h + 1e-4) * z, a, b))
        spots.append((middle + (0.5 * size + 1e-4) * a + 0.5 * h * z, b, z))
    for angle in (1.2, 3.3, 5.4):
        turn = np.array([np.cos(2 * angle), np.sin(2 * angle), 0.0])
        place = 0.35 * np.array([np.cos(angle), np.sin(angle), 0.0]) + 1e-4 * z
        spots.append((place, turn, np.cross(z, turn)))
    paper = SIDE_M * (1.0 + 2.0 * MARGIN)
    for number, (middle, right, up) in enumerate(spots[:8]):
        corner = middle - 0.5 * paper * right + 0.5 * paper * up
        quads.append(Quad(u * corner, u * paper * right, -u * paper * up, marker_image(number)))
    return quads


def ring_cameras(count: int, width: int, height: int) -> list[Camera]:
    """Return cameras around the table at two heights."""
    out = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        radius, high = (1.55, 0.85) if i % 2 else (1.35, 1.25)
        eye = UNITS_PER_METRE * np.array([radius * np.cos(angle), radius * np.sin(angle), high])
        pose = look_at_pose(eye, [0.0, 0.0, 0.12 * UNITS_PER_METRE])
        focal, name = 0.95 * width, f"photo{i:03d}.png"
        out.append(Camera(name, width, height, focal, focal, width / 2, height / 2, pose))
    return out


def photograph(quads: list[Quad], camera: Camera, k1: float = 0.0) -> np.ndarray:
    """Return the (height, width) uint8 photo of a camera with radial distortion ``k1``."""
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    u = ((np.arange(camera.width)[:, None] + steps).ravel() - camera.cx) / camera.fx
    v = ((np.arange(camera.height)[:, None] + steps).ravel() - camera.cy) / camera.fy
    slopes = np.stack(np.meshgrid(u, v), -1)  # (h, w, 2), as the lens bends them
    straight = slopes.copy()
    for _ in range(12 if k1 else 0):
        straight = slopes / (1.0 + k1 * (straight**2).sum(-1, keepdims=True))
    rays = np.concatenate([straight, np.ones((*straight.shape[:2], 1))], -1) @ camera.rotation
    depth = np.full(rays.shape[:2], np.inf)
    color = np.full(rays.shape[:2], 170.0, np.float32)
    for quad in quads:
        box = _window(quad, camera, k1)
        _draw(quad, camera.center, rays[box], depth[box], color[box])
    h, w = camera.height, camera.width
    return np.rint(color.reshape(h, SAMPLES, w, SAMPLES).mean((1, 3))).astype(np.uint8)


def _window(quad: Quad, camera: Camera, k1: float) -> tuple[slice, slice]:
    """Return the rows and columns of rays that may meet a quad."""
    along = np.linspace(0.0, 1.0, 17)[:, None]
    a, b, c = quad.corner, quad.corner + quad.right, quad.corner + quad.down
    edges = [a + along * quad.right, a + along * quad.down, b + along * quad.down]
    local = camera.to_camera(np.concatenate([*edges, c + along * quad.right]))
    if local[:, 2].min() <= 0.0:
        return slice(None), slice(None)
    slopes = local[:, :2] / local[:, 2:]
    slopes = slopes * (1.0 + k1 * (slopes**2).sum(1, keepdims=True))
    pixels = slopes * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    low = np.floor(SAMPLES * pixels.min(0)).astype(int) - 2
    high = np.ceil(SAMPLES * pixels.max(0)).astype(int) + 2
    return slice(max(low[1], 0), max(high[1], 0)), slice(max(low[0], 0), max(high[0], 0))


def _draw(
    quad: Quad, eye: np.ndarray, rays: np.ndarray, depth: np.ndarray, color: np.ndarray
) -> None:
    normal = np.cross(quad.right, quad.down)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((quad.corner - eye) @ normal) / (rays @ normal)  # (h, w)
    near = np.isfinite(distance) & (distance > 1e-6) & (distance < depth)
    rows, columns = np.nonzero(near)
    if not len(rows):
        return
    local = eye + distance[rows, columns, None] * rays[rows, columns] - quad.corner
    s = local @ quad.right / (quad.right @ quad.right)
    t = local @ quad.down / (quad.down @ quad.down)
    inside = (s >= 0) & (s < 1) & (t >= 0) & (t < 1)
    rows, columns, s, t = rows[inside], columns[inside], s[inside], t[inside]
    height, width = quad.texture.shape
    color[rows, columns] = quad.texture[(t * height).astype(int), (s * width).astype(int)]
    depth[rows, columns] = distance[rows, columns]


def write_photos(folder: Path, count: int, width: int, height: int, *, k1: float) -> None:
    """Write blurred ``images/`` and, beside it, ``transforms.json`` with the exact cameras."""
    from scipy.ndimage import gaussian_filter

    (folder / "images").mkdir(parents=True, exist_ok=True)
    quads, cameras = table_scene(), ring_cameras(count, width, height)
    frames: list[dict[str, Any]] = []
    rng = np.random.default_rng(1)
    for camera in cameras:
        photo = gaussian_filter(photograph(quads, camera, k1).astype(np.float64), 0.6)
        photo = np.clip(np.rint(photo + rng.normal(0.0, 1.5, photo.shape)), 0, 255)
        color = np.repeat(photo.astype(np.uint8)[..., None], 3, 2)
        Image.fromarray(color).save(folder / "images" / camera.name)
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = camera.center
        frames.append({"file_path": f"images/{camera.name}", "transform_matrix": pose.tolist()})
    first = cameras[0]
    lens = {
        "camera_model": "OPENCV", "w": width, "h": height, "fl_x": first.fx, "fl_y": first.fy,
        "cx": first.cx, "cy": first.cy, "k1": k1, "k2": 0.0, "p1": 0.0, "p2": 0.0,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
