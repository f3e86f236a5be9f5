# SPDX-License-Identifier: GPL-3.0-or-later
"""Images and per-Gaussian statistics of one rendered view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor


@dataclass
class RenderStatistics:
    """Per-Gaussian statistics of one view, (n,) unless noted otherwise.

    Gradient statistics are filled by the backward pass. The weights are (0,) if only screen
    gradients were requested.
    """

    visible: np.ndarray
    """bool: reaches at least one tile of the image."""
    radii_px: np.ndarray
    """float32: half of the longer side of the screen box."""
    weight_sum: np.ndarray
    """float32: sum over pixels of the blending weight alpha * T."""
    weight_max: np.ndarray
    """float32: largest blending weight at any pixel."""
    grad_px: np.ndarray
    """float32: norm of the loss gradient with respect to the projected mean, per pixel."""
    grad_abs_px: np.ndarray
    """float32: the same with absolute values summed over pixels (AbsGS)."""
    strongest: np.ndarray | None = None
    """(h, w) int32: index of the Gaussian with the largest weight at the pixel, or -1."""


@dataclass
class Render:
    """Images of one view; differentiable with respect to the Gaussians' tensors."""

    color: Tensor  # (h, w, 3) background composited
    normal: Tensor  # (h, w, 3) blended learned normals, scene frame, background 0
    geometric_normal: Tensor  # (h, w, 3) blended geometric normals, scene frame, facing the camera
    alpha: Tensor  # (h, w) 1 - final transmittance
    depth: Tensor  # (h, w) z-depth of the 0.5-isosurface, scene units; 0 where there is none
    statistics: RenderStatistics | None = None
