# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians and cameras shared by the tests of the fields."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.poses import look_at_pose


def camera_at(eye: np.ndarray, *, focal: float = 300.0) -> Camera:
    """Return a 400 x 300 camera at ``eye`` that looks at the origin, principal point off centre."""
    pose = look_at_pose(eye)
    return Camera("view", 400, 300, focal, 1.02 * focal, 203.0, 148.0, pose)


def unit_sphere(count: int) -> np.ndarray:
    """Return ``count`` Fibonacci points on the unit sphere."""
    i = np.arange(count) + 0.5
    polar = np.arccos(1.0 - 2.0 * i / count)
    turn = np.pi * (1.0 + 5.0**0.5) * i
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], 1)


def cameras_around(count: int, radius: float = 4.0) -> list[Camera]:
    """Return cameras on a sphere that look at the origin."""
    return [camera_at(radius * direction) for direction in unit_sphere(count)]


def make_arrays(
    means: np.ndarray,
    scales: np.ndarray,
    alphas: np.ndarray | float,
    *,
    rotations: np.ndarray | None = None,
    normals: np.ndarray | None = None,
) -> GaussianArrays:
    """Return Gaussian arrays; identity rotations and no orientation by default."""
    means = np.asarray(means, np.float64).reshape(-1, 3)
    count = len(means)
    if rotations is None:
        rotations = np.tile(np.eye(3), (count, 1, 1))
    return GaussianArrays(
        means,
        np.ascontiguousarray(np.broadcast_to(np.asarray(scales, np.float64), (count, 3))),
        np.ascontiguousarray(rotations, np.float64),
        np.log(np.broadcast_to(np.asarray(alphas, np.float64), (count,))).copy(),
        np.zeros((count, 3)) if normals is None else np.ascontiguousarray(normals, np.float64),
        np.zeros((count, 1, 3), np.float32),
    )


def random_arrays(
    count: int, seed: int = 0, scale: tuple[float, float] = (1e-3, 0.1)
) -> GaussianArrays:
    """Return anisotropic oriented Gaussians in a cloud of standard deviation 1."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals *= (rng.random(count) / np.linalg.norm(normals, axis=1))[:, None]
    return make_arrays(
        rng.normal(size=(count, 3)),
        np.exp(rng.uniform(np.log(scale[0]), np.log(scale[1]), (count, 3))),
        rng.uniform(0.005, 0.995, count),
        rotations=Rotation.random(count, random_state=seed).as_matrix(),
        normals=normals,
    )


def shell_arrays(
    alpha: float, *, sigma_n: float = 0.005, count: int = 2000, scale: float = 1.0
) -> GaussianArrays:
    """Return the shell of flat Gaussians of docs/method.md, section 10.3, times ``scale``."""
    outward = unit_sphere(count)
    first = np.cross(outward, [0.3, 0.5, 0.8])
    first /= np.linalg.norm(first, axis=1)[:, None]
    rotations = np.stack([first, np.cross(outward, first), outward], 2)
    return make_arrays(
        scale * outward,
        scale * np.array([0.05, 0.05, sigma_n]),
        alpha,
        rotations=rotations,
        normals=0.95 * outward,
    )


def around_shell(count: int, spread: float, seed: int = 0) -> np.ndarray:
    """Return points near the unit sphere, radii spread by a standard deviation ``spread``."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    return points * (1.0 + spread * rng.normal(size=(count, 1)))


def query_points(
    arrays: GaussianArrays, count: int, near: float = 0.02, seed: int = 1
) -> np.ndarray:
    """Return points anywhere, points ``near`` Gaussians, and centres, ``count`` of each."""
    rng = np.random.default_rng(seed)
    means = arrays.means[rng.integers(0, len(arrays), count)]
    return np.concatenate(
        [rng.normal(size=(count, 3)), means + near * rng.normal(size=(count, 3)), means]
    )
