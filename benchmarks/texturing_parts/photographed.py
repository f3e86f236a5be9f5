# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a mesh with a known texture, by rays; another renderer than the one that is judged."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.scene import Scene, View
from gaussian_wrapping_addon.core.dataset.similarity import Similarity
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh

from ..scenes.geometry import read_obj, scaled_to
from ..scenes.viewpoints import around_thing
from ..scenes.visibility import RayScene

MESHES = Path(__file__).resolve().parents[1] / "meshes"
DIAGONAL = 2.0
DISTANCE = 2.1
BACKGROUND = (40.0, 90.0, 60.0)
RAYS_AT_ONCE = 400_000

Pattern = Callable[[np.ndarray], np.ndarray]
Unevenness = Callable[[int, np.ndarray], np.ndarray]
"""Factor of a photo's brightness at (n, 2) positions in [0, 1], by the photo's number."""


@dataclasses.dataclass
class RenderedPhotos:
    """The methods of ``PhotoStore`` on images in memory."""

    cameras: list[Camera]
    images: list[np.ndarray]

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Camera of the photo reduced by whole blocks."""
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
        """(h, w, 3) uint8, means of blocks."""
        image = self.images[index]
        height, width = image.shape[0] // divisor, image.shape[1] // divisor
        cut = image[: height * divisor, : width * divisor]
        blocks = cut.reshape(height, divisor, width, divisor, 3)
        return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)

    def mask(self, index: int, divisor: int = 1) -> None:
        """No masks."""
        return

    def scene(self) -> Scene:
        """Return a scene of these views without sparse points."""
        views = tuple(View(camera, Path("unused.png")) for camera in self.cameras)
        nothing = np.zeros((0, 3))
        return Scene(views, nothing, nothing.astype(np.uint8), Similarity())


def spot() -> SurfaceMesh:
    """Return the cow, z up, of diagonal 2 around 0."""
    vertices, faces, _ = read_obj(MESHES / "spot.obj")
    upright = vertices @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return SurfaceMesh(scaled_to(upright, DIAGONAL), faces)


def cameras_around(count: int, width: int, height: int, seed: int = 0) -> list[Camera]:
    """Return cameras on rings around 0."""
    random = np.random.default_rng(seed)
    return around_thing(count, width, height, DISTANCE, random, "photo")


def uneven(index: int, places: np.ndarray) -> np.ndarray:
    """Return the brightness of one photo: dark corners, and a gradient of 6 to 10 % either way."""
    random = np.random.default_rng(1000 + index)
    direction = random.normal(size=2)
    direction *= random.uniform(0.12, 0.2) / np.linalg.norm(direction)
    offset = places - 0.5
    return (1.0 + offset @ direction) * (1.0 - 0.5 * (offset**2).sum(axis=1))


def photograph(
    mesh: SurfaceMesh,
    pattern: Pattern,
    cameras: list[Camera],
    supersampling: int,
    unevenness: Unevenness | None = None,
) -> RenderedPhotos:
    """Render the mesh unlit: each pixel the mean of ``supersampling``^2 rays."""
    rays = RayScene(mesh.vertices, mesh.faces)
    images = []
    for index, camera in enumerate(cameras):
        image = _render(rays, pattern, camera, supersampling)
        if unevenness is not None:
            rows, columns = np.mgrid[: camera.height, : camera.width]
            places = np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2)
            places /= [camera.width, camera.height]
            image *= unevenness(index, places).reshape(camera.height, camera.width, 1)
        images.append(np.rint(image.clip(0, 255)).astype(np.uint8))
    return RenderedPhotos(cameras, images)


def _render(rays: RayScene, pattern: Pattern, camera: Camera, supersampling: int) -> np.ndarray:
    fine = camera.resized(camera.width * supersampling, camera.height * supersampling)
    rows = max(1, RAYS_AT_ONCE // fine.width // supersampling) * supersampling
    parts = []
    for begin in range(0, fine.height, rows):
        end = min(begin + rows, fine.height)
        y, x = np.mgrid[begin:end, : fine.width]
        local = np.stack(
            [(x + 0.5 - fine.cx) / fine.fx, (y + 0.5 - fine.cy) / fine.fy, np.ones(x.shape)], -1
        )
        directions = (local @ fine.rotation).reshape(-1, 3)
        origins = np.broadcast_to(fine.center, directions.shape)
        distance, face = rays.first_hits(origins, directions)
        hit = face >= 0
        colors = np.broadcast_to(np.array(BACKGROUND), directions.shape).copy()
        colors[hit] = pattern(fine.center + directions[hit] * distance[hit, None])
        blocks = colors.reshape(-1, supersampling, camera.width, supersampling, 3)
        parts.append(blocks.mean(axis=(1, 3)))
    return np.concatenate(parts)
