# SPDX-License-Identifier: GPL-3.0-or-later
"""Bicubic resampling of photos at fractional pixel positions, compiled."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from ..kernels.parallel import even_bounds, run_chunks


def sample_bicubic(photo: np.ndarray, where: np.ndarray, threads: int = 1) -> np.ndarray:
    """Sample a photo with Catmull-Rom weights; coordinates are clamped at the border.

    Parameters
    ----------
    photo : (h, w, c) uint8
    where : (rows, columns, 2) float32
        Pixel coordinates x, y in ``photo``; the first pixel's centre is (0.5, 0.5).
    threads : int

    Returns
    -------
    (rows, columns, c) uint8
    """
    photo = np.ascontiguousarray(photo)
    where = np.ascontiguousarray(where, np.float32)
    out = np.zeros((*where.shape[:2], photo.shape[2]), np.uint8)
    rows = _rows_kernel()

    def work(begin: int, end: int) -> None:
        rows(photo, where, out, begin, end)

    run_chunks(work, even_bounds(len(out), threads), threads)
    return out


@functools.lru_cache(maxsize=1)
def _rows_kernel() -> Callable[..., Any]:
    # numba is imported on first use: the package's readers must load without it.
    from ..kernels.compiled import kernel

    return kernel(fast=True)(_sample_rows)


def _sample_rows(
    photo: np.ndarray, where: np.ndarray, out: np.ndarray, begin: int, end: int
) -> None:
    height, width, channels = photo.shape
    wx = np.zeros(4, np.float32)
    wy = np.zeros(4, np.float32)
    for row in range(begin, end):
        for column in range(out.shape[1]):
            x = min(max(where[row, column, 0] - np.float32(0.5), 0.0), width - 1.0)
            y = min(max(where[row, column, 1] - np.float32(0.5), 0.0), height - 1.0)
            x0, y0 = int(x), int(y)
            fx, fy = np.float32(x - x0), np.float32(y - y0)
            wx[0] = fx * (np.float32(-0.5) + fx * (np.float32(1.0) - np.float32(0.5) * fx))
            wx[1] = np.float32(1.0) + fx * fx * (np.float32(1.5) * fx - np.float32(2.5))
            wx[2] = fx * (np.float32(0.5) + fx * (np.float32(2.0) - np.float32(1.5) * fx))
            wx[3] = fx * fx * (np.float32(0.5) * fx - np.float32(0.5))
            wy[0] = fy * (np.float32(-0.5) + fy * (np.float32(1.0) - np.float32(0.5) * fy))
            wy[1] = np.float32(1.0) + fy * fy * (np.float32(1.5) * fy - np.float32(2.5))
            wy[2] = fy * (np.float32(0.5) + fy * (np.float32(2.0) - np.float32(1.5) * fy))
            wy[3] = fy * fy * (np.float32(0.5) * fy - np.float32(0.5))
            for channel in range(channels):
                total = np.float32(0.0)
                for i in range(4):
                    yi = min(max(y0 + i - 1, 0), height - 1)
                    line = np.float32(0.0)
                    for j in range(4):
                        xj = min(max(x0 + j - 1, 0), width - 1)
                        line += wx[j] * np.float32(photo[yi, xj, channel])
                    total += wy[i] * line
                out[row, column, channel] = np.uint8(
                    min(max(total + np.float32(0.5), np.float32(0.0)), np.float32(255.0))
                )
