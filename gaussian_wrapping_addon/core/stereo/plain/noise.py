# SPDX-License-Identifier: GPL-3.0-or-later
"""Noise of photos in their plain parts (docs/method.md, section 11.12)."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

LEAST_PIXELS = 200
"""Plain pixels of a photo that its noise is measured in, at least."""

DARKEST, BRIGHTEST = 1.0, 254.0
"""Grey levels between which noise shows."""

_SECOND_DIFFERENCES = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
_MEDIAN_OF_UNIT_NOISE = 6.0 * 0.6745
"""Of the size of second differences of white noise: their standard deviation is 6."""


def noise_level(color: np.ndarray, plain: np.ndarray) -> float:
    """Return the standard deviation of noise of a photo, grey levels, of its channels' mean.

    From second differences in both directions, which leave out shading and straight steps
    [Immerkaer 1996]. Too few plain pixels tell no noise: 0.

    Parameters
    ----------
    color : (h, w, c) float32
        Channels of the photo as taken, or one grey one.
    plain : (h, w) bool
        Pixels without texture; those that are black or saturated are left out, as they show none.
    """
    shown = ((color > DARKEST) & (color < BRIGHTEST)).all(-1)
    inner = ndimage.binary_erosion(plain & shown, np.ones((3, 3)))
    if inner.sum() < LEAST_PIXELS:
        return 0.0
    found = [
        np.median(np.abs(ndimage.convolve(channel, _SECOND_DIFFERENCES)[inner]))
        for channel in np.moveaxis(color, -1, 0)
    ]
    return float(np.mean(found)) / _MEDIAN_OF_UNIT_NOISE


def smoothed_noise(noise: Any, sigma_px: Any) -> Any:
    """Return the standard deviations of white noise after Gaussian filters of these widths."""
    return noise / (2.0 * np.sqrt(np.pi) * sigma_px)


def smoothed_step_noise(noise: float, sigma_px: float) -> float:
    """Return that of the difference of two neighbours after a Gaussian filter."""
    shared = np.exp(-1.0 / (4.0 * sigma_px**2))
    return float(smoothed_noise(noise, sigma_px) * np.sqrt(2.0 * (1.0 - shared)))
