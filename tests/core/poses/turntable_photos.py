# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of spot turning before a static, textured background, by rays, with the exact truth.

Camera, light, wall and table stand still; the cow turns in equal steps. Poses are those of the
camera as the cow sees it: on a circle around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.known_texture import SolidTexture, spot
from benchmarks.scenes.geometry import RayScene, count_views, look_at
from gaussian_wrapping_addon.core.evaluation.surface_scores import Truth, sample_uniformly
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.scene.camera import Camera

DISTANCE, ELEVATIONS_DEGREES, FOCAL_SHARE = 3.1, (18.0, 42.0), 1.25
"""The camera stands still at one elevation after the other, for as many photos each."""
WALL_Y, TABLE_Z = 1.6, -0.62
"""The wall's place behind the cow, and the table's, a little below its hoofs."""
LIGHT = np.array([0.45, -0.65, 0.62])
AMBIENT = 0.55
NOISE_LEVELS = 1.5
SUPERSAMPLING = 2
TRUTH_SAMPLES = 100_000
JPEG_QUALITY = 95
FOCAL_35MM = 36.0
"""Width of the film that EXIF's focal length refers to, mm."""


@dataclass(frozen=True)
class Turntable:
    """Photos, their exact cameras in the cow's frame, and the cow."""

    photos: list[np.ndarray]
    cameras: list[Camera]
    mesh: SurfaceMesh

    @property
    def mesh_diagonal(self) -> float:
        """Of the box around the cow."""
        return float(np.linalg.norm(np.ptp(self.mesh.vertices, axis=0)))


def turntable(count: int, width: int, height: int, *, elevations: int = 1) -> Turntable:
    """Render the photos.

    Parameters
    ----------
    count : int
        Number of photos, of all elevations together.
    elevations : int
        How many of ``ELEVATIONS_DEGREES``.
    """
    mesh, random = spot(), np.random.default_rng(0)
    rays, texture = RayScene(mesh.vertices, mesh.faces), SolidTexture(1)
    light = LIGHT / np.linalg.norm(LIGHT)
    photos: list[np.ndarray] = []
    cameras: list[Camera] = []
    each = -(-count // elevations)
    for elevation in ELEVATIONS_DEGREES[:elevations]:
        still = _camera(width, height, elevation)
        fine = still.resized(width * SUPERSAMPLING, height * SUPERSAMPLING)
        directions = _directions(fine)
        behind = _background(fine, directions, SolidTexture(2))
        for step in range(min(each, count - len(photos))):
            turn = _about_z(2.0 * np.pi * step / each)  # cow in the room
            origins = np.broadcast_to(turn.T @ fine.center, directions.shape)
            distance, face = rays.first_hits(origins, directions @ turn)
            hit = face >= 0
            colors = behind.copy()
            points = origins[hit] + (directions[hit] @ turn) * distance[hit, None]
            lit = (rays.normals[face[hit]] @ (turn.T @ light)).clip(0.0)
            colors[hit] = texture(points) * (AMBIENT + (1.0 - AMBIENT) * lit)[:, None]
            blocks = colors.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 3).mean((1, 3))
            noisy = blocks + random.normal(size=blocks.shape) * NOISE_LEVELS
            photos.append(np.rint(noisy.clip(0, 255)).astype(np.uint8))
            pose = np.column_stack([still.rotation @ turn, still.cam_from_world[:, 3]])
            cameras.append(
                Camera(
                    f"{len(photos) - 1:03d}.jpg", width, height, still.fx, still.fy, still.cx,
                    still.cy, pose,
                )
            )  # fmt: skip
    return Turntable(photos, cameras, mesh)


def write_photos(made: Turntable, folder: Path) -> None:
    """Write the photos as a camera does: JPEG with the focal length in EXIF."""
    folder.mkdir(parents=True)
    for photo, camera in zip(made.photos, made.cameras, strict=True):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA405] = round(FOCAL_35MM * camera.fx / camera.width)
        Image.fromarray(photo).save(folder / camera.name, quality=JPEG_QUALITY, exif=exif)


def truth_of(made: Turntable) -> Truth:
    """Return the true surface, and how many photos show each of its samples."""
    rays = RayScene(made.mesh.vertices, made.mesh.faces)
    samples = sample_uniformly(made.mesh.vertices, made.mesh.faces, TRUTH_SAMPLES, seed=0)
    seen = count_views(rays, made.cameras, samples.points, samples.normals)
    return Truth(samples, made.mesh.vertices, made.mesh.faces, seen=seen)


def _camera(width: int, height: int, elevation_degrees: float) -> Camera:
    lift = np.radians(elevation_degrees)
    center = DISTANCE * np.array([0.0, -np.cos(lift), np.sin(lift)])
    pose = look_at(center, np.array([0.03, 0.0, 0.0]), 0.0)
    focal = FOCAL_SHARE * width
    return Camera("", width, height, focal, focal, width / 2, height / 2, pose)


def _directions(camera: Camera) -> np.ndarray:
    y, x = np.mgrid[: camera.height, : camera.width]
    local = np.stack(
        [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(x.shape)], -1
    )
    return (local @ camera.rotation).reshape(-1, 3)


def _background(camera: Camera, directions: np.ndarray, texture: SolidTexture) -> np.ndarray:
    """Return (n, 3) colours of wall and table, whichever a ray meets first."""
    with np.errstate(divide="ignore"):
        wall = (WALL_Y - camera.center[1]) / directions[:, 1]
        table = (TABLE_Z - camera.center[2]) / directions[:, 2]
    wall[wall <= 0.0], table[table <= 0.0] = np.inf, np.inf
    nearest = np.minimum(wall, table)[:, None]
    return texture(camera.center + directions * nearest + [5.0, 3.0, 7.0])


def _about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
