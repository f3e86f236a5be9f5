# SPDX-License-Identifier: GPL-3.0-or-later
"""Analytic scenes for texture tests: photos by exact ray casting against spheres and boxes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from tests.poses import look_at_pose

Pattern = Callable[[np.ndarray], np.ndarray]
SUPERSAMPLING = 2


def waves(points: np.ndarray) -> np.ndarray:
    """Smooth colours in [0, 255] as a function of the position."""
    phase = points @ np.array([[2.1, -1.3, 0.4], [1.2, 2.4, -1.1], [-0.7, 1.0, 2.6]])
    return 127.5 + 100.0 * np.sin(phase + np.array([0.0, 1.0, 2.0]))


def plain(color: tuple[float, float, float]) -> Pattern:
    """A constant colour."""
    return lambda points: np.broadcast_to(np.array(color, float), points.shape)


def look_at(eye, target=(0.0, 0.0, 0.0), width=200, height=150, focal=170.0) -> Camera:
    pose = look_at_pose(eye, target)
    return Camera("c", width, height, focal, focal, width / 2, height / 2, pose)


def sphere_hit(origin: np.ndarray, rays: np.ndarray, radius: float = 1.0) -> np.ndarray:
    """Ray parameters of the first hit with a sphere around 0, infinite where missed."""
    a = (rays * rays).sum(-1)
    b = rays @ origin
    inside = b * b - a * (origin @ origin - radius**2)
    t = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
    return np.where((inside > 0) & (t > 0), t, np.inf)


def box_hit(origin: np.ndarray, rays: np.ndarray, low, high) -> np.ndarray:
    """Ray parameters of the first hit with an axis-aligned box from outside."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one = (np.asarray(low, float) - origin) / rays
        other = (np.asarray(high, float) - origin) / rays
    enter = np.nanmax(np.minimum(one, other), axis=-1)
    leave = np.nanmin(np.maximum(one, other), axis=-1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def shoot(camera: Camera, things, background=30.0) -> np.ndarray:
    """Photograph things, each a pair (hit(origin, rays) -> t, pattern), antialiased."""
    fine = camera.resized(camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING)
    rays = fine.rays() @ fine.rotation  # (h, w, 3), world
    depth = np.full(rays.shape[:2], np.inf)
    image = np.full(rays.shape, background)
    for hit, pattern in things:
        t = hit(camera.center, rays)
        nearer = t < depth
        points = camera.center + rays[nearer] * t[nearer][:, None]
        image[nearer] = pattern(points)
        depth[nearer] = t[nearer]
    blocks = image.reshape(camera.height, SUPERSAMPLING, camera.width, SUPERSAMPLING, 3)
    return np.rint(blocks.mean(axis=(1, 3)).clip(0, 255)).astype(np.uint8)


@dataclasses.dataclass
class FakePhotos:
    """The methods of PhotoStore on images in memory."""

    cameras: list[Camera]
    images: list[np.ndarray]
    masks: list[np.ndarray] | None = None

    def camera(self, index: int, divisor: int = 1) -> Camera:
        base = self.cameras[index]
        return dataclasses.replace(
            base,
            width=base.width // divisor,
            height=base.height // divisor,
            fx=base.fx / divisor,
            fy=base.fy / divisor,
            cx=base.cx / divisor,
            cy=base.cy / divisor,
        )

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        return np.rint(_blocks(self.images[index], divisor)).astype(np.uint8)

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        if self.masks is None:
            return None
        return _blocks(self.masks[index][..., None], divisor)[..., 0] >= 0.5


def _blocks(image: np.ndarray, divisor: int) -> np.ndarray:
    height, width = image.shape[0] // divisor, image.shape[1] // divisor
    cut = image[: height * divisor, : width * divisor]
    return cut.reshape(height, divisor, width, divisor, -1).mean(axis=(1, 3))


def scene_of(photos: FakePhotos, world_from_scene: Similarity | None = None) -> Scene:
    views = tuple(View(camera, Path("unused.png")) for camera in photos.cameras)
    nothing = np.zeros((0, 3))
    return Scene(views, nothing, nothing.astype(np.uint8), world_from_scene or Similarity())


def ring(count: int, radius: float, height: float) -> list[Camera]:
    angles = np.arange(count) * 2 * np.pi / count
    return [look_at((radius * np.cos(a), radius * np.sin(a), height)) for a in angles.tolist()]


def photograph(cameras: list[Camera], things) -> FakePhotos:
    return FakePhotos(cameras, [shoot(camera, things) for camera in cameras])


def mesh_of(shape: trimesh.Trimesh) -> SurfaceMesh:
    return SurfaceMesh(np.array(shape.vertices, float), np.array(shape.faces, np.int32))


def sphere(subdivisions: int = 4, radius: float = 1.0) -> SurfaceMesh:
    return mesh_of(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))


def box(low, high, pieces: int = 3) -> SurfaceMesh:
    shape = trimesh.creation.box(bounds=[low, high])
    for _ in range(pieces):
        shape = shape.subdivide()
    return mesh_of(shape)


def joined(*meshes: SurfaceMesh) -> SurfaceMesh:
    vertices, faces, base = [], [], 0
    for mesh in meshes:
        vertices.append(mesh.vertices)
        faces.append(mesh.faces + base)
        base += len(mesh.vertices)
    return SurfaceMesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32))
