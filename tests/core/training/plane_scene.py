# SPDX-License-Identifier: GPL-3.0-or-later
"""A patterned plane seen by two cameras, exactly or through Gaussians that lie on it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.multi_view import _ViewPair
from tests.core.render.scenes import look_at

NORMAL = np.array([0.0, 0.0, 1.0])
EYE, OTHER_EYE = (0.3, -1.4, 2.6), (-0.4, -1.2, 2.7)


@dataclass
class PlaneView:
    """What the terms read of a rendered view."""

    depth: np.ndarray
    geometric_normal: np.ndarray
    alpha: np.ndarray


def camera_pair() -> tuple[Camera, Camera]:
    """Return a reference of 64 x 48 px and another camera of 58 x 50 px, 17 degrees aside."""
    reference = look_at(EYE, width=64, height=48, focal=80.0)
    return reference, look_at(OTHER_EYE, width=58, height=50, focal=70.0, name="other")


def plane_depth(camera: Camera, height: float = 0.0) -> np.ndarray:
    """Return (h, w) z-depth of the plane z = height."""
    rays = camera.rays() @ camera.rotation  # (h, w, 3) z-depth 1
    return (height - camera.center[2]) / rays[..., 2]


def plane_photo(camera: Camera, *, contrast: float = 0.4) -> np.ndarray:
    """Return (h, w, 3) float64 photo of a smooth pattern on the plane z = 0."""
    rays = camera.rays() @ camera.rotation
    place = camera.center + plane_depth(camera)[..., None] * rays
    x, y = place[..., 0], place[..., 1]
    wave = np.sin(5.0 * x + 1.0) + np.sin(6.5 * y - 2.0 * x) + np.sin(4.0 * y + 3.0 * x)
    return np.repeat((0.5 + contrast / 3.0 * wave)[..., None], 3, 2)


def plane_view(camera: Camera, normal: np.ndarray = NORMAL, length: float = 1.0) -> PlaneView:
    """Return the exact float64 images of the plane."""
    depth = plane_depth(camera)
    normals = np.broadcast_to(length * normal / np.linalg.norm(normal), (*depth.shape, 3))
    return PlaneView(depth, normals.copy(), np.ones_like(depth))


def moved(view: PlaneView, **images: np.ndarray) -> PlaneView:
    """Return the view with other images."""
    return dataclasses.replace(view, **images)


def pair_of(view: PlaneView, pixels: np.ndarray, threads: int = 1) -> _ViewPair:
    """Return what the terms make of the exact view."""
    reference, other = camera_pair()
    return _ViewPair(view, reference, other, pixels, 0.2, threads)  # type: ignore[arg-type]


def grey_of(photo: np.ndarray) -> np.ndarray:
    """Return (h, w) float32."""
    return np.ascontiguousarray(photo[..., 0], np.float32)


def inner_pixels(camera: Camera, border: int = 12, step: int = 3) -> np.ndarray:
    """Return (m,) int32 pixels of a grid away from the border."""
    row, column = np.mgrid[border : camera.height - border : step, border : camera.width - border]
    return (row * camera.width + column).ravel().astype(np.int32)


def plane_gaussians(*, side: int = 24, noise: float = 0.0, seed: int = 0) -> OrientedGaussians:
    """Return flat float32 Gaussians on z = 0, moved and turned at random by ``noise``."""
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(*[np.linspace(-1.4, 1.4, side)] * 2)
    count = x.size
    means = np.stack([x.ravel(), y.ravel(), np.zeros(count)], 1)
    means += noise * random.normal(size=(count, 3)) * [1.0, 1.0, 0.3]
    spacing = 2.8 / (side - 1)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)) + noise * random.normal(size=(count, 4))
    scales = np.tile([0.7 * spacing, 0.7 * spacing, 0.02], (count, 1))
    arrays = {
        "means": means,
        "log_scales": np.log(scales),
        "quats": quats,
        "opacity_logits": np.full(count, 2.5),
        "sh": np.zeros((count, 4, 3)),
        "orientation": np.zeros((count, 4)),
        "filter_3d": np.zeros(count),
    }
    return OrientedGaussians(
        **{name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
    )
