# SPDX-License-Identifier: GPL-3.0-or-later
"""Gradients with respect to the images of a view and to its visible Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class ImageGradients:
    """Gradient of a scalar with respect to the images of a view; ``None`` means zeros.

    numpy arrays, or tensors where the images are tensors.
    """

    color: Any = None  # (h, w, 3)
    normal: Any = None  # (h, w, 3)
    geometric_normal: Any = None  # (h, w, 3)
    alpha: Any = None  # (h, w)
    depth: Any = None  # (h, w)


@dataclass(frozen=True)
class VisibleGradients:
    """Gradients of a scalar with respect to the raw parameters of the visible Gaussians.

    Arrays are C-contiguous float32; row k belongs to Gaussian ``ids[k]``. They may be views of
    scratch memory that the next rendering overwrites.
    """

    ids: np.ndarray  # (v,) int32, increasing
    means: np.ndarray  # (v, 3)
    log_scales: np.ndarray  # (v, 3)
    quats: np.ndarray  # (v, 4)
    opacity_logits: np.ndarray  # (v,)
    sh: np.ndarray  # (v, k, 3)
    orientation: np.ndarray  # (v, 4)
