# SPDX-License-Identifier: GPL-3.0-or-later
"""Noise of photos in their plain parts (docs/method.md, section 11.12)."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

DARKEST, BRIGHTEST = 1.0, 254.0
"""Grey levels between which noise shows."""

SIDES_PX = (1, 2)
"""Of the squares whose means are looked at. Resizing and JPEG take noise of single pixels away and
leave that of squares, which texture is made of, too; squares of 4 px show faint texture itself."""

BLOCK, LEAST_USED, LEAST_BLOCKS = 16, 0.5, 4
"""Squares along the side of a block (so that a block of squares of 2 px has 32), share of them that
must be usable, and blocks needed."""

QUIET_BLOCKS, QUIET_SHARE = 0.25, 0.945
"""Quantile of the blocks that counts, and share of white noise that it shows. Faint texture shows
in most blocks; within one the mean of the power counts, as JPEG flattens most blocks of its own and
leaves few differences, large ones."""

_SECOND_DIFFERENCES = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32) / 6.0
"""Leave the standard deviation of white noise as it is."""


def noise_levels(color: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Return (c,) the standard deviations of white noise as strong as that of a photo, grey levels.

    From second differences in both directions, which leave out shading and straight steps
    [Immerkaer 1996], of pixels and of means of squares; the largest counts. Too few plain pixels
    tell no noise: 0.

    Parameters
    ----------
    color : (h, w, c) float32
        Channels of the photo as taken.
    plain : (h, w) bool
        Pixels without texture; those that are black or saturated are left out, as they show none.
    """
    usable = plain & ((color > DARKEST) & (color < BRIGHTEST)).all(-1)
    found = np.zeros(color.shape[-1])
    for side in SIDES_PX:
        inner = ndimage.binary_erosion(_means(usable, side) == 1.0, np.ones((3, 3)))
        used = _means(inner, BLOCK)
        chosen = used >= LEAST_USED
        if chosen.sum() < LEAST_BLOCKS:
            continue
        for number, channel in enumerate(np.moveaxis(color, -1, 0)):
            differences = ndimage.convolve(_means(channel, side), _SECOND_DIFFERENCES)
            power = _means(np.where(inner, differences, 0.0) ** 2, BLOCK)[chosen] / used[chosen]
            level = side / QUIET_SHARE * np.sqrt(np.quantile(power, QUIET_BLOCKS))
            found[number] = max(found[number], level)
    return found


def _means(image: np.ndarray, side: int) -> np.ndarray:
    """Return the means over squares of an image (h, w), as many as fit."""
    height, width = image.shape[0] // side, image.shape[1] // side
    squares = image[: height * side, : width * side].reshape(height, side, width, side)
    return squares.mean((1, 3), dtype=np.float32)


def smoothed_noise(noise: Any, sigma_px: Any) -> Any:
    """Return the standard deviations of white noise after Gaussian filters of these widths."""
    return noise / (2.0 * np.sqrt(np.pi) * sigma_px)


def smoothed_step_noise(noise: float, sigma_px: float) -> float:
    """Return that of the difference of two neighbours after a Gaussian filter."""
    shared = np.exp(-1.0 / (4.0 * sigma_px**2))
    return float(smoothed_noise(noise, sigma_px) * np.sqrt(2.0 * (1.0 - shared)))
