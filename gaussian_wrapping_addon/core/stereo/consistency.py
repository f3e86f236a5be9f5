# SPDX-License-Identifier: GPL-3.0-or-later
"""Which sources confirm the depth of a pixel (docs/method.md, section 11.4)."""

from __future__ import annotations

import numpy as np

from ..kernels.compiled import kernel
from .plane_kernels import F32, HALF, NEAREST_Z, ONE, ZERO, back_error_px

AGREEING_PX = F32(1)
AGREEING_SHARE = F32(0.01)
"""Largest forward-backward error and relative difference in depth of two views that agree."""


@kernel(fast=True)
def confirm(
    planes: np.ndarray, maps: np.ndarray, back_maps: np.ndarray, inverse_depths: np.ndarray,
    all_planes: np.ndarray, sizes: np.ndarray, bases: np.ndarray, stride: float,
    sources: np.ndarray, means: np.ndarray,
) -> None:  # fmt: skip
    """Find the sources whose own depth agrees with that of each pixel.

    Parameters
    ----------
    planes : (h, w, 3) float32
    maps, back_maps : (s, 12) float32
    inverse_depths : (p,) float32, all_planes : (p, 3) float32
        Of all pixels of all photos.
    sizes, bases, stride
        Of the sources (:func:`~.sweep.sweep`).
    sources : (h, w) uint8
        Written: bits of those that agree.
    means : (h, w) float32
        Written: mean inverse depth over the pixel and those.
    """
    for row in range(planes.shape[0]):
        for column in range(planes.shape[1]):
            u, v, w = F32(column), F32(row), planes[row, column, 0]
            total, count, bits = w, ONE, 0
            for s in range(maps.shape[0]):
                m = maps[s]
                z = m[6] * u + m[7] * v + m[8] + w * m[11]
                if z <= NEAREST_Z:
                    continue
                x = (m[0] * u + m[1] * v + m[2] + w * m[9]) / z
                y = (m[3] * u + m[4] * v + m[5] + w * m[10]) / z
                if x < ZERO or y < ZERO or x >= sizes[s, 0] or y >= sizes[s, 1]:
                    continue
                error_px = back_error_px(s, u, v, x, y, back_maps, inverse_depths, bases[s], stride)
                if error_px > AGREEING_PX:
                    continue
                nearest_x, nearest_y = np.int32(x + HALF), np.int32(y + HALF)
                there = bases[s] + np.uint64(nearest_y * np.int32(stride) + nearest_x)
                other = inverse_depths[there]
                other += all_planes[there, 1] * (x - F32(nearest_x))
                other += all_planes[there, 2] * (y - F32(nearest_y))
                if abs(other * z - w) > AGREEING_SHARE * w:
                    continue
                bits |= 1 << s
                total += other * z
                count += ONE
            sources[row, column] = np.uint8(bits)
            means[row, column] = total / count
