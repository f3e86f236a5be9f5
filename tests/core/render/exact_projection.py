# SPDX-License-Identifier: GPL-3.0-or-later
"""The projection's columns, and their gradient, in arithmetic of 60 digits."""

from __future__ import annotations

import mpmath
import numpy as np

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.scene.camera import Camera

Exact = dict[str, list[mpmath.mpf]]


def exact_values(gaussians: OrientedGaussians) -> Exact:
    """Parameters of one Gaussian that its shape on the screen depends on."""
    names = ("means", "log_scales", "quats")
    return {name: [mpmath.mpf(v) for v in getattr(gaussians, name)[0].tolist()] for name in names}


def exact_columns(raw: Exact, camera: Camera) -> list[mpmath.mpf]:
    """Columns 0-10, 12 and 19-22 of one unfiltered Gaussian with 60 digits."""
    with mpmath.workdps(60):
        w, x, y, z = raw["quats"]
        n = mpmath.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w / n, x / n, y / n, z / n
        turn = mpmath.matrix(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        pose = mpmath.matrix(camera.cam_from_world.tolist())
        view = pose[:, 0:3]
        mean = view * mpmath.matrix(raw["means"]) + pose[:, 3]
        axes = view * turn
        variance = mpmath.diag([mpmath.exp(2 * s) for s in raw["log_scales"]])
        covariance = axes * variance * axes.T
        precision = axes * variance**-1 * axes.T
        ray = mean / mean[2]
        slant = precision * ray
        a0 = (ray.T * slant)[0]
        fx, fy = mpmath.mpf(camera.fx), mpmath.mpf(camera.fy)
        kx, ky = slant[0] / fx, slant[1] / fy
        bxx, bxy, byy = precision[0, 0] / fx**2, precision[0, 1] / fx / fy, precision[1, 1] / fy**2
        zz = mean[2] ** 2
        normal = view.T * slant * (-1 / mpmath.norm(slant))
        return [
            fx * ray[0] + camera.cx, fy * ray[1] + camera.cy,
            zz * (bxx - kx * kx / a0), 2 * zz * (bxy - kx * ky / a0), zz * (byy - ky * ky / a0),
            kx / a0, ky / a0, bxx / a0, 2 * bxy / a0, byy / a0, mean[2], a0,
            normal[0], normal[1], normal[2], mpmath.sqrt(covariance[2, 2]),
        ]  # fmt: skip


EXACT_COLUMNS = [*range(11), 12, *range(19, 23)]


def exact_gradient(raw: Exact, camera: Camera, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Gradient of the weighted sum of the exact columns, by central differences of 60 digits."""
    with mpmath.workdps(60):
        step = mpmath.mpf(10) ** -20

        def total(name: str, k: int, change: mpmath.mpf) -> mpmath.mpf:
            values = {**raw, name: [v + change * (j == k) for j, v in enumerate(raw[name])]}
            columns = exact_columns(values, camera)
            return mpmath.fsum(w * c for w, c in zip(weights.tolist(), columns, strict=True))

        return {
            name: np.array(
                [
                    float((total(name, k, step) - total(name, k, -step)) / (2 * step))
                    for k in range(len(values))
                ]
            )
            for name, values in raw.items()
        }
