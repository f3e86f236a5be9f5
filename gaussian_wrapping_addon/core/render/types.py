# SPDX-License-Identifier: GPL-3.0-or-later
"""What a renderer takes and gives; the reference and the kernels share these."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from .. import limits, tolerances


@dataclass(frozen=True)
class RenderOptions:
    """Options of one rendering."""

    depth: bool = True
    """Solve the 0.5-isosurface depth (and its gradient); off where no depth loss is active."""
    sh_degree: int | None = None
    """Use only this degree of the stored harmonics; ``None`` uses all."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near_z: float = tolerances.NEAR_Z
    depth_valid_transmittance: float = tolerances.DEPTH_VALID_TRANSMITTANCE
    threads: int = 0
    """0 uses every core this process may use."""
    statistics: bool = False
    """Gather all of :class:`RenderStatistics` (wrapping, pruning)."""
    screen_gradients: bool = False
    """Gather only ``visible``, ``radii_px``, ``grad_px`` and ``grad_abs_px`` (density control):
    spares the sums of blending weights."""
    budget_bytes: int = limits.RENDER_BUDGET_BYTES
    """What everything that grows with the (tile, Gaussian) pairs may take. An image whose pairs do
    not fit is rendered in bands of tiles; a band is never smaller than one tile."""

    @property
    def gathers_statistics(self) -> bool:
        """Whether a rendering has statistics at all."""
        return self.statistics or self.screen_gradients


@dataclass
class RenderStatistics:
    """Per-Gaussian figures of one view, all (n,) unless said otherwise.

    Gradient figures are filled when ``backward`` runs through the render. The weights are (0,)
    where only the screen gradients were asked for.
    """

    visible: np.ndarray
    """bool: reached at least one tile of the image."""
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


@dataclass(frozen=True)
class ImageGradients:
    """Gradient of a scalar with respect to the images of a view; ``None`` stands for zeros."""

    color: np.ndarray | None = None  # (h, w, 3)
    normal: np.ndarray | None = None  # (h, w, 3)
    geometric_normal: np.ndarray | None = None  # (h, w, 3)
    alpha: np.ndarray | None = None  # (h, w)
    depth: np.ndarray | None = None  # (h, w)


@dataclass(frozen=True)
class VisibleGradients:
    """Gradients of a scalar with respect to the raw parameters of the Gaussians that were seen.

    Arrays are C-contiguous float32; row k belongs to Gaussian ``ids[k]``. They may be views of
    scratch that the next rendering overwrites.
    """

    ids: np.ndarray  # (v,) int32, increasing
    means: np.ndarray  # (v, 3)
    log_scales: np.ndarray  # (v, 3)
    quats: np.ndarray  # (v, 4)
    opacity_logits: np.ndarray  # (v,)
    sh: np.ndarray  # (v, k, 3)
    orientation: np.ndarray  # (v, 4)
