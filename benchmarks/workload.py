# SPDX-License-Identifier: GPL-3.0-or-later
"""The Gaussians and camera that every timing of the renderer uses."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.scene.camera import Camera

DISTANCE = 4.2
"""From the camera to the scene's middle, scene units."""
_ELEVATION, _AZIMUTH = -0.35, 0.4
_SIGMAS = (0.022, 0.016, 0.005)
"""Medians of the three standard deviations: discs that lie roughly in the surface."""


def surface_gaussians(count: int, seed: int = 0, *, sh_degree: int = 2) -> OrientedGaussians:
    """Return ``count`` float32 discs near a sphere, a torus and a plane, opacity 0.03 to 0.6.

    Half of them lie near the unit sphere, a quarter near the torus around it (radii 1.6 and 0.3)
    and a quarter near a square plane below; sizes are log-normal, normals are slightly off.
    """
    random = np.random.default_rng(seed)

    def unit(vectors: np.ndarray) -> np.ndarray:
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    on_sphere, on_torus = count // 2, count // 4
    on_plane = count - on_sphere - on_torus
    sphere = unit(random.normal(size=(on_sphere, 3)))  # points and normals alike

    around, across = random.uniform(0.0, 2.0 * math.pi, (2, on_torus))
    outward = np.stack([np.cos(around), np.zeros(on_torus), np.sin(around)], 1)  # (m, 3)
    up = np.array([0.0, 1.0, 0.0])
    torus_normals = outward * np.cos(across)[:, None] + up * np.sin(across)[:, None]
    torus = 1.6 * outward + 0.3 * torus_normals

    plane = np.stack(
        [
            random.uniform(-2.2, 2.2, on_plane),
            np.full(on_plane, 1.1),
            random.uniform(-2.2, 2.2, on_plane),
        ],
        1,
    )
    means = np.concatenate([sphere, torus, plane])
    means += random.normal(scale=0.015, size=(count, 3))
    normals = np.concatenate([sphere, torus_normals, np.broadcast_to(-up, (on_plane, 3))])
    normals = unit(normals + random.normal(scale=0.25, size=(count, 3)))
    tangents = unit(np.cross(normals, random.normal(size=(count, 3))))
    axes = np.stack([tangents, np.cross(normals, tangents), normals], 2)  # (n, 3, 3) columns
    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]  # w x y z
    log_scales = np.log(_SIGMAS) + random.normal(scale=0.45, size=(count, 3))
    opacity = random.uniform(0.03, 0.6, count)
    sh = random.normal(scale=0.1, size=(count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = random.uniform(-1.0, 1.0, (count, 3))
    orientation = np.concatenate([normals, np.ones((count, 1))], 1)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(values, np.float32))

    return OrientedGaussians(
        tensor(means),
        tensor(log_scales),
        tensor(quats),
        tensor(np.log(opacity) - np.log1p(-opacity)),
        tensor(sh),
        tensor(orientation),
        torch.zeros(count),
    )


def view(width: int, height: int) -> Camera:
    """Return the camera that sees the whole workload, focal length = image width."""
    ca, sa = math.cos(_AZIMUTH), math.sin(_AZIMUTH)
    ce, se = math.cos(_ELEVATION), math.sin(_ELEVATION)
    turn = np.array([[ca, 0.0, sa], [0.0, 1.0, 0.0], [-sa, 0.0, ca]])
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, ce, -se], [0.0, se, ce]])
    pose = np.concatenate([tilt @ turn, [[0.0], [0.0], [DISTANCE]]], 1)  # (3, 4)
    focal = float(width)
    return Camera("view", width, height, focal, focal, width / 2, height / 2, pose)
