# SPDX-License-Identifier: GPL-3.0-or-later
"""Images resampled, as numbers, in grey."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from .errors import UsageError
from .parallel import even_bounds, run_chunks

# -- Bicubic resampling of photos at fractional pixel positions, compiled -------------------------


def sample_bicubic(photo: np.ndarray, where: np.ndarray, threads: int = 1) -> np.ndarray:
    """Sample a photo (h, w, c) uint8 with Catmull-Rom weights, into (rows, columns, c) uint8.

    ``where`` (rows, columns, 2) float32 holds pixel coordinates x, y in the photo, clamped at its
    border; the first pixel's centre is (0.5, 0.5).
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
    from .compiled import kernel

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


# -- Convert images to floats; check that images to compare have the same size --------------------


def as_unit_floats(image: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """Return (h, w, 3) colours in [0, 1]: uint8 is divided by 255, floats are unchanged."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3:
        raise UsageError(f"An image has the shape {image.shape}.", "Give (height, width, 3).")
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image, dtype) * dtype(1.0 / 255.0)
    return np.ascontiguousarray(image, dtype)


def check_sizes(
    image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None, *, may_be_empty: bool = False
) -> None:
    """Raise ``UsageError`` if the shapes differ, or if the mask must not be empty but is."""
    if image.shape != photo.shape or (mask is not None and mask.shape != image.shape[:2]):
        raise UsageError(
            f"Image {image.shape}, photo {photo.shape} and mask differ in size.",
            "Compare images of one camera.",
        )
    if not may_be_empty and (image.size == 0 or (mask is not None and not mask.any())):
        raise UsageError("The mask leaves no pixel to measure.", "Check the mask.")


# -- Grey levels of colours -----------------------------------------------------------------------


LUMA = (0.299, 0.587, 0.114)  # shares of red, green and blue in a grey level (ITU-R BT.601)


def grey_of(colors: np.ndarray) -> np.ndarray:
    """Return the grey levels (...) float32 of colours (..., 3) of any type, not rounded."""
    return np.asarray(colors @ np.array(LUMA, np.float32), np.float32)
