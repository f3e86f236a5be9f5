# SPDX-License-Identifier: GPL-3.0-or-later
"""Opacity prior: what photos leave open is opaque."""

from __future__ import annotations

import numpy as np

from ...render.types.gradients import VisibleGradients

FAINT, SURE = 0.2, 0.5
"""Opacity up to which a Gaussian is left to the photos, and from which the prior counts fully."""


def add_opacity_prior(
    gradients: VisibleGradients, opacity_logits: np.ndarray, shares: np.ndarray, weight: float
) -> float:
    """Add the gradient of ``-weight`` times the mean prior of the Gaussians over a pixel.

    A thin dark rod before a lawn looks the same as a darker one that is half transparent: photos
    alone leave its opacity open, and where that is below 0.5 there is no surface. Things are
    opaque, so the opaque one is taken. See docs/method.md, section 3.7.

    Parameters
    ----------
    gradients : VisibleGradients
        The gradient is added to ``opacity_logits``, but for Gaussians whose opacity no pixel
        asks about.
    opacity_logits : (n,) float32
        Raw, of all Gaussians.
    shares : (v,) float32
        Shares of the image in the footprints of the Gaussians that the gradient belongs to
        (:func:`~.footprint_regulariser.footprint_shares`).
    weight : float
        Setting ``lambda_opacity``.

    Returns
    -------
    float
        Mean over the pixels of the sum over Gaussians of ``4 k(o)``, where ``k`` is the integral
        of a ramp from 0 at :data:`FAINT` to 1 at :data:`SURE`.
    """
    # The optimizer takes a 0 for a Gaussian not seen.
    area = shares * (gradients.opacity_logits != 0.0)
    opacity = 1.0 / (1.0 + np.exp(-opacity_logits[gradients.ids]))
    ramp = np.clip((opacity - FAINT) / (SURE - FAINT), 0.0, 1.0)
    gradients.opacity_logits[...] -= 4.0 * weight * area * ramp * opacity * (1.0 - opacity)
    integral = 0.5 * (SURE - FAINT) * ramp**2 + np.maximum(opacity - SURE, 0.0)
    return float(4.0 * (area * integral).sum())
