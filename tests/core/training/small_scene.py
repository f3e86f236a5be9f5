# SPDX-License-Identifier: GPL-3.0-or-later
"""A tiny scene whose photos were rendered from known Gaussians, and photos held in memory."""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import render_reference
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from tests.core.render.scenes import look_at

RADIUS = 1.0


class PhotosInMemory:
    """Photos of one size, with the interface of ``PhotoStore``."""

    def __init__(self, scene: Scene, photos: list[np.ndarray], masks: list | None = None) -> None:
        self.scene, self.photos = scene, photos
        self.masks = masks or [None] * len(photos)

    def camera(self, index: int, divisor: int = 1) -> Camera:
        base = self.scene.views[index].camera
        return dataclasses.replace(
            base, width=base.width // divisor, height=base.height // divisor,
            fx=base.fx / divisor, fy=base.fy / divisor,
            cx=base.cx / divisor, cy=base.cy / divisor,
        )  # fmt: skip

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        camera, photo = self.camera(index, divisor), self.photos[index]
        cut = photo[: camera.height * divisor, : camera.width * divisor].astype(float)
        blocks = cut.reshape(camera.height, divisor, camera.width, divisor, 3)
        return np.round(blocks.mean((1, 3))).astype(np.uint8)

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        mask = self.masks[index]
        return None if mask is None else mask[::divisor, ::divisor]


def surface_color(directions: np.ndarray) -> np.ndarray:
    """Return (n, 3) colours in [0.1, 0.9] of the sphere's points in unit directions."""
    return 0.5 + 0.4 * np.sin(3.0 * directions + [0.0, 1.0, 2.0])


def sphere_gaussians(count: int = 150, *, opacity: float = 0.95) -> OrientedGaussians:
    """Return flat Gaussians on a sphere, colours a smooth function of the place, normals out."""
    steps = np.arange(count) + 0.5
    z = 1 - 2 * steps / count
    angle = math.pi * (1 + 5**0.5) * steps
    ring = np.sqrt(1 - z * z)
    normals = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)
    # The quaternion that turns the third axis onto the normal.
    quats = np.stack([1 + z, -normals[:, 1], normals[:, 0], np.zeros(count)], 1)
    spacing = math.sqrt(4 * math.pi / count)
    sizes = np.tile([0.6 * spacing, 0.6 * spacing, 0.05], (count, 1)) * RADIUS
    color = surface_color(normals)
    arrays = {
        "means": RADIUS * normals,
        "log_scales": np.log(sizes),
        "quats": quats,
        "opacity_logits": np.full(count, math.log(opacity / (1 - opacity))),
        "sh": ((color - 0.5) / 0.28209479)[:, None],
        "orientation": np.concatenate([normals, np.ones((count, 1))], 1),
        "filter_3d": np.zeros(count),
    }
    return OrientedGaussians(
        **{k: torch.from_numpy(v.astype(np.float32)) for k, v in arrays.items()}
    )


def ring_cameras(count: int, size_px: int) -> list[Camera]:
    """Return cameras around the sphere, at two heights."""
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        eye = (4.0 * math.cos(angle), 4.0 * math.sin(angle), 1.8 if i % 2 else -1.0)
        camera = look_at(
            eye, width=size_px, height=size_px, focal=1.5 * size_px, name=f"{i:03d}.png"
        )
        cameras.append(camera)
    return cameras


@functools.lru_cache(maxsize=4)
def sphere_scene(
    views: int = 12, size_px: int = 32, points: int = 200
) -> tuple[Scene, PhotosInMemory]:
    """Return the scene with noisy sparse points, and its photos."""
    truth = sphere_gaussians()
    cameras = ring_cameras(views, size_px)
    options = RenderOptions(depth=False)
    images = [render_reference(truth, c, options).color.numpy() for c in cameras]
    photos = [np.round(255 * np.clip(i, 0, 1)).astype(np.uint8) for i in images]
    random = np.random.default_rng(0)
    places = random.normal(size=(points, 3))
    places *= RADIUS / np.linalg.norm(places, axis=1, keepdims=True)
    colors = np.round(255 * surface_color(places / RADIUS)).astype(np.uint8)
    places += 0.02 * random.normal(size=places.shape)
    scene = Scene(
        tuple(View(c, Path(c.name)) for c in cameras),
        places,
        colors,
        Similarity(),
    )
    return scene, PhotosInMemory(scene, photos)
