# SPDX-License-Identifier: GPL-3.0-or-later
"""Noise of photos in their plain parts (docs/method.md, section 11.12)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import ndimage

LEAST_PIXELS = 200
"""Plain pixels of an image below which it does not count."""

_SECOND_DIFFERENCES = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
_MEDIAN_OF_UNIT_NOISE = 6.0 * 0.6745
"""Of the size of second differences of white noise: their standard deviation is 6."""


def noise_levels(images: Sequence[np.ndarray], plain: Sequence[np.ndarray]) -> float:
    """Return the standard deviation of noise, grey levels, the median over images; 0 if unknown.

    From second differences in both directions, which leave out shading and straight steps
    [Immerkaer 1996].

    Parameters
    ----------
    images : sequence of (h, w) float32
    plain : sequence of (h, w) bool
        Pixels without texture, of each image.
    """
    found = []
    for image, where in zip(images, plain, strict=True):
        inner = ndimage.binary_erosion(where, np.ones((3, 3)))
        if inner.sum() >= LEAST_PIXELS:
            curved = ndimage.convolve(image, _SECOND_DIFFERENCES)[inner]
            found.append(float(np.median(np.abs(curved))) / _MEDIAN_OF_UNIT_NOISE)
    return float(np.median(found)) if found else 0.0


def smoothed_noise(noise: float, sigma_px: Any) -> Any:
    """Return the standard deviation of white noise after Gaussian filters of these widths."""
    return noise / (2.0 * np.sqrt(np.pi) * sigma_px)


def smoothed_step_noise(noise: float, sigma_px: float) -> float:
    """Return that of the difference of two neighbours after a Gaussian filter."""
    shared = np.exp(-1.0 / (4.0 * sigma_px**2))
    return float(smoothed_noise(noise, sigma_px) * np.sqrt(2.0 * (1.0 - shared)))
