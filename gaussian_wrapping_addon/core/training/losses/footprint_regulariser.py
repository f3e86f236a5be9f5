# SPDX-License-Identifier: GPL-3.0-or-later
"""Footprint regulariser: penalise the mean number of Gaussians that overlap a pixel."""

from __future__ import annotations

import numpy as np

from ...render.types.gradients import VisibleGradients


def footprint_shares(boxes: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Return the share of an image that lies in each Gaussian's box.

    Parameters
    ----------
    boxes : (v, 4) float32
        Footprints on the screen: x0, y0, x1, y1 in pixels.
    size_px : (int, int)
        Width and height of the image; area outside it does not count.

    Returns
    -------
    (v,) float32
    """
    width, height = size_px
    box = np.clip(boxes, 0.0, np.array([width, height, width, height], np.float32))  # (v, 4)
    area = (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1])  # (v,)
    return area / np.float32(width * height)


def add_footprint_regulariser(
    gradients: VisibleGradients, log_scales: np.ndarray, shares: np.ndarray, weight: float
) -> float:
    """Add the gradient of ``weight`` times the mean number of Gaussians over a pixel.

    Blending costs time for every Gaussian whose footprint contains a pixel, visible or occluded.
    Photos alone do not penalise this: half-transparent layers that overlap a hundredfold look the
    same as a few small opaque ones, but take longer and have no surface. The footprint is the box
    on the screen; its area grows with the square of the scale, and the gradient is distributed over
    the axes by their squares. The weight is the setting ``overlap_price``.

    Parameters
    ----------
    gradients : VisibleGradients
        The gradient is added to ``log_scales``.
    log_scales : (n, 3) float32
        Raw, of all Gaussians.
    shares : (v,) float32
        Of the Gaussians that the gradient belongs to (:func:`footprint_shares`).
    weight : float
        Loss of one Gaussian over every pixel.

    Returns
    -------
    float
        Mean number of Gaussians over a pixel.
    """
    squares = np.exp(2.0 * log_scales[gradients.ids])  # (v, 3)
    squares *= (2.0 * weight * shares / squares.sum(1))[:, None]
    gradients.log_scales[...] += squares
    return float(shares.sum())
