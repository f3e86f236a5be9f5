# SPDX-License-Identifier: GPL-3.0-or-later
"""Options, images and gradients of a rendering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from .. import limits
from ..scene.camera import Camera

# -- Gradients with respect to the images of a view and to its visible Gaussians ------------------


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


# -- Images and per-Gaussian statistics of one rendered view --------------------------------------


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


# -- Rendering options ----------------------------------------------------------------------------


@dataclass(frozen=True)
class RenderOptions:
    """Options of one rendering."""

    depth: bool = True
    """Solve the 0.5-isosurface depth (and its gradient); disable where no depth loss is active."""
    sh_degree: int | None = None
    """Use only this degree of the stored harmonics; ``None`` uses all."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near_z: float = limits.NEAR_Z
    depth_valid_transmittance: float = limits.DEPTH_VALID_TRANSMITTANCE
    threads: int = 0
    """0 uses every core available to this process."""
    statistics: bool = False
    """Collect all of :class:`~.types.RenderStatistics` (wrapping, pruning)."""
    screen_gradients: bool = False
    """Collect only ``visible``, ``radii_px``, ``grad_px`` and ``grad_abs_px`` (density control),
    without the sums of blending weights."""
    budget_bytes: int = limits.RENDER_BUDGET_BYTES
    """Memory for everything that grows with the number of tile intersections. An image whose
    intersections do not fit is rendered in bands of tiles; a band is at least one tile."""

    @property
    def gathers_statistics(self) -> bool:
        """Whether a rendering collects any statistics."""
        return self.statistics or self.screen_gradients


# -- What renders whole views, on whatever device -------------------------------------------------


class Renderer(Protocol):
    """Renders one view after the other.

    Implemented by :class:`~.view_renderer.ViewRenderer` and
    :class:`~.device_renderer.DeviceRenderer`.
    """

    def render(self, gaussians: Any, camera: Camera, options: RenderOptions) -> Any:
        """Return a view of ``RawArrays`` with images and statistics as numpy arrays.

        They are valid until the next call. ``backward`` takes ``ImageGradients`` and returns
        ``VisibleGradients``.
        """
