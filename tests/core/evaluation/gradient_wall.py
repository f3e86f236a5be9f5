# SPDX-License-Identifier: GPL-3.0-or-later
"""A textured square whose photos are known in closed form."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from tests.core.texture.texture_scenes import look_at


def gradient_wall(size_px: int = 64) -> TexturedMesh:
    """A square from (-1, 0, -1) to (1, 0, 1), red to the right, green upwards, facing -y."""
    vertices = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    ramp = (np.arange(size_px) + 0.5) / size_px * 255
    image = np.zeros((size_px, size_px, 3))
    image[..., 0] = ramp[None, :]
    image[..., 1] = ramp[::-1, None]
    return TexturedMesh(SurfaceMesh(vertices, faces), uv[faces], np.rint(image).astype(np.uint8))


def wall_hit(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origin[1] / rays[..., 1]
        points = origin + rays * t[..., None]
    inside = (t > 0) & (np.abs(points[..., [0, 2]]) <= 1).all(axis=-1)
    return np.where(inside, t, np.inf)


def wall_color(points: np.ndarray) -> np.ndarray:
    out = np.zeros(points.shape)
    out[..., 0] = (points[..., 0] + 1) / 2 * 255
    out[..., 1] = (points[..., 2] + 1) / 2 * 255
    return out


CAMERAS = [
    look_at((0.0, -3.0, 0.0), (0, 0, 0), width=120, height=90, focal=120.0),
    look_at((1.5, -2.5, 1.0), (0, 0, 0), width=120, height=90, focal=120.0),
]
