# SPDX-License-Identifier: GPL-3.0-or-later
"""Brute-force vacancy, every Gaussian at every point: for tests and benchmarks only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ... import tolerances
from ...dataset.camera import Camera
from ...gaussians.model import GaussianArrays
from .stable_logs import log_gaussian, log_one_minus

PAIRS_PER_BLOCK = 2_000_000


def log_transmittance(arrays: GaussianArrays, center: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the log transmittance between a camera centre and points.

    See docs/method.md, section 5.1.

    Only for tests and benchmarks, since the cost is Gaussians x points.

    Parameters
    ----------
    arrays : GaussianArrays
        All ``m`` Gaussians are included, also those beside or behind the camera (which contribute
        their value at the camera, docs/method.md, section 5.4).
    center : (3,) float64
        Camera centre, scene frame.
    points : (n, 3) float64
        Scene frame.

    Returns
    -------
    (n,) float64
        ``sum_i log(1 - G_i(o + min(t, t*_i) w))``.
    """
    points = np.ascontiguousarray(points, np.float64)
    # L = S^-1 R^T; the difference is taken before whitening, where it is exact.
    whiten = arrays.rotations.transpose(0, 2, 1) / arrays.scales[:, :, None]  # (m, 3, 3)
    offset = np.einsum("mij,mj->mi", whiten, arrays.means - center)  # (m, 3)
    out = np.empty(len(points))
    block = max(1, PAIRS_PER_BLOCK // max(1, len(arrays)))
    for begin in range(0, len(points), block):
        ray = points[begin : begin + block] - center  # (b, 3), the point is at parameter 1
        step = np.einsum("mij,bj->bmi", whiten, ray)  # (b, m, 3)
        length_sq = np.einsum("bmi,bmi->bm", step, step)
        peak = np.einsum("bmi,mi->bm", step, offset) / np.maximum(length_sq, 1e-300)  # (b, m)
        at = np.clip(peak, 0.0, 1.0)
        residual = offset - at[:, :, None] * step  # (b, m, 3)
        q = np.einsum("bmi,bmi->bm", residual, residual)
        out[begin : begin + block] = log_one_minus(log_gaussian(arrays.log_opacities, q)).sum(1)
    return out


def brute_force_vacancy(
    arrays: GaussianArrays,
    cameras: Sequence[Camera],
    points: np.ndarray,
    *,
    near_z: float = tolerances.NEAR_Z,
) -> tuple[np.ndarray, np.ndarray]:
    """Return vacancy and arg-max camera in float64, without culling, cut-off or early exit.

    For tests and benchmarks only (see :func:`log_transmittance`).

    Parameters
    ----------
    points : (n, 3) float64
        Scene frame.
    near_z : float
        A camera sees a point that lies in its image and deeper than this (scene units).

    Returns
    -------
    vacancy : (n,) float64
        Largest transmittance over the cameras that see the point; NaN where none does.
    camera : (n,) int32
        The first camera that attains it, or -1.
    """
    points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    best = np.full(len(points), -np.inf)
    camera_index = np.full(len(points), -1, np.int32)
    for index, camera in enumerate(cameras):
        pixels, depth = camera.project(points)
        seen = (depth > near_z) & (pixels >= 0.0).all(1)
        seen &= (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height)
        rows = np.flatnonzero(seen)
        if len(rows) == 0:
            continue
        value = np.exp(log_transmittance(arrays, camera.center, points[rows]))
        better = value > best[rows]
        best[rows[better]] = value[better]
        camera_index[rows[better]] = index
    return np.where(camera_index >= 0, best, np.nan), camera_index
