# SPDX-License-Identifier: GPL-3.0-or-later
"""How close a rendered view is to its photo: PSNR and SSIM, over the pixels of a mask."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..errors import UsageError
from ..parallel import even_bounds, run_chunks
from .ssim_kernels import RADIUS, WINDOW, similarity_gradient_rows, similarity_rows

_NO_MASK = np.zeros((0, 0), np.bool_)


@dataclass(frozen=True)
class Similarity:
    """Mean SSIM, the number of values it is a mean of, and its gradient where asked for."""

    mean: float
    values: int
    gradient: np.ndarray | None
    """(h, w, 3): derivative of the mean with respect to the image."""


def as_unit_floats(image: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """Return (h, w, 3) colours in [0, 1]: uint8 is divided by 255, floats are kept."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3:
        raise UsageError(f"An image has the shape {image.shape}.", "Give (height, width, 3).")
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image, dtype) * dtype(1.0 / 255.0)
    return np.ascontiguousarray(image, dtype)


def psnr(image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB; infinite for equal images.

    Parameters
    ----------
    image, photo : (h, w, 3)
        uint8, or floats whose white is 1. The image is clamped to [0, 1] as a display would.
    mask : (h, w) bool, optional
        Pixels to measure.

    Raises
    ------
    UsageError
        If the shapes differ or no pixel is left.
    """
    a = np.clip(as_unit_floats(image, np.float64), 0.0, 1.0)
    b = as_unit_floats(photo, np.float64)
    _check(a, b, mask)
    error = (a - b) ** 2 if mask is None else (a - b)[np.asarray(mask, bool)] ** 2
    mean = float(error.mean())
    return math.inf if mean == 0.0 else -10.0 * math.log10(mean)


def ssim(
    image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None, *, threads: int = 1
) -> float:
    """Return the mean structural similarity (method.md 3.1); see :func:`similarity`.

    The image is clamped to [0, 1] as a display would.
    """
    a = np.clip(as_unit_floats(image, np.float64), 0.0, 1.0)
    return similarity(a, as_unit_floats(photo, np.float64), mask, threads=threads).mean


def similarity(
    image: np.ndarray,
    photo: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    gradient: bool = False,
    threads: int = 1,
) -> Similarity:
    """Return the mean SSIM over windows and colours, with its gradient where asked for.

    The window is 11 x 11, Gaussian with sigma 1.5, "valid" padding. With a mask, both images
    are black outside of it, and only windows centred inside it are counted.

    Parameters
    ----------
    image, photo : (h, w, 3) float32 or float64, contiguous, the same type
        Colours in [0, 1].
    mask : (h, w) bool, optional
        Pixels to compare.
    gradient : bool
        Also return the derivative with respect to ``image``.

    Returns
    -------
    Similarity
        ``mean`` is 1 and ``values`` is 0 where no window fits or none is left.

    Raises
    ------
    UsageError
        If the shapes differ.
    """
    if mask is not None:
        mask = np.ascontiguousarray(mask, np.bool_)
    _check(image, photo, mask, may_be_empty=True)
    height, width = image.shape[:2]
    if min(height, width) < WINDOW:
        return Similarity(1.0, 0, np.zeros_like(image) if gradient else None)
    if mask is not None:
        image, photo = (x * mask[..., None].astype(x.dtype) for x in (image, photo))
    flat_image = np.ascontiguousarray(image).reshape(height, 3 * width)
    flat_photo = np.ascontiguousarray(photo).reshape(height, 3 * width)
    out_rows, out_values = height - 2 * RADIUS, 3 * (width - 2 * RADIUS)
    sums, counts = np.zeros(out_rows), np.zeros(out_rows, np.int64)
    maps = np.empty((3, out_rows, out_values) if gradient else (3, 0, 0), image.dtype)
    flat_mask = _NO_MASK if mask is None else mask

    def forward(begin: int, end: int) -> None:
        similarity_rows(begin, end, flat_image, flat_photo, flat_mask, sums, counts, maps)

    run_chunks(forward, even_bounds(out_rows, threads, 2), threads)
    values = int(counts.sum())
    mean = float(sums.sum()) / values if values else 1.0
    if not gradient:
        return Similarity(mean, values, None)
    result = np.zeros_like(flat_image)
    factor = 1.0 / max(1, values)

    def backward(begin: int, end: int) -> None:
        similarity_gradient_rows(begin, end, flat_image, flat_photo, maps, factor, result)

    run_chunks(backward, even_bounds(height, threads, 2), threads)
    shaped = result.reshape(height, width, 3)
    if mask is not None:
        shaped *= mask[..., None]
    return Similarity(mean, values, shaped)


def _check(
    image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None, *, may_be_empty: bool = False
) -> None:
    if image.shape != photo.shape or (mask is not None and mask.shape != image.shape[:2]):
        raise UsageError(
            f"Image {image.shape}, photo {photo.shape} and mask differ in size.",
            "Compare images of one camera.",
        )
    if not may_be_empty and (image.size == 0 or (mask is not None and not mask.any())):
        raise UsageError("The mask leaves no pixel to measure.", "Check the mask.")
