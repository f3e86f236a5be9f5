# SPDX-License-Identifier: GPL-3.0-or-later
"""What an iteration computes, whatever computes it; windows of photos."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..image_metrics import RADIUS, WINDOW
from ..render.types import ImageGradients, RenderOptions
from ..scene.camera import Camera
from ..scene.scene import PhotoSource
from ..stereo.depth_maps import DepthPrior
from .adam import Adam
from .density import DensityStatistics
from .exposure import Exposure
from .multi_view import MultiViewOptions

# -- Split large photos into overlapping windows, one of which is trained on per iteration --------

OVERLAP_PX = 16
"""Overlap of neighbouring windows: SSIM leaves out five pixels along the border of each."""


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels."""

    left: int
    top: int
    width: int
    height: int

    def camera(self, camera: Camera) -> Camera:
        """Return the camera cropped to this window."""
        if (self.left, self.top, self.width, self.height) == (0, 0, camera.width, camera.height):
            return camera
        return dataclasses.replace(
            camera, width=self.width, height=self.height, cx=camera.cx - self.left,
            cy=camera.cy - self.top,
        )  # fmt: skip

    def of(self, image: np.ndarray) -> np.ndarray:
        """Crop an (h, w, ...) image to this window, C-contiguous."""
        part = image[self.top : self.top + self.height, self.left : self.left + self.width]
        return np.ascontiguousarray(part)


def windows(width: int, height: int, max_pixels: int) -> list[Window]:
    """Split an image into equal windows of about ``max_pixels`` at most, row by row.

    A part of the pixels gives nearly the same gradient as all of them, and more steps are worth
    more than exact gradients; so time goes into iterations.
    """
    count = max(1, math.ceil(math.sqrt(width * height / max_pixels)))
    columns = min(count, max(1, width // (2 * OVERLAP_PX)))
    rows = min(count, max(1, height // (2 * OVERLAP_PX)))
    wide, high = _side(width, columns), _side(height, rows)
    lefts = np.linspace(0, width - wide, columns).round().astype(int).tolist()
    tops = np.linspace(0, height - high, rows).round().astype(int).tolist()
    return [Window(left, top, wide, high) for top in tops for left in lefts]


def _side(length: int, parts: int) -> int:
    return length if parts == 1 else math.ceil((length + (parts - 1) * OVERLAP_PX) / parts)


# -- What a training iteration needs of a device, as one narrow interface -------------------------
#
# Arrays are the backend's own: numpy on the CPU, tensors on a device. The iteration only hands
# them from one method to the next. Gradients on images are :class:`ImageGradients` of such
# arrays.


@dataclass(frozen=True)
class Shown:
    """A photo, or a window of it, as arrays of a backend."""

    photo: Any  # (h, w, 3) uint8
    mask: Any  # (h, w) bool, true where the photo counts, or None
    pixels: int
    """Number of pixels that the mask leaves."""
    windows: int
    """Number of SSIM windows centred on them."""


class Backend(ABC):
    """Computes the parts of an iteration."""

    name: str
    """Such as "cpu" or "cuda:0"."""
    renderer: Any
    """Renders whole views for what happens between iterations (``ViewRenderer``'s interface)."""

    @abstractmethod
    def adopted(self, adam: Adam) -> Adam:
        """Return the optimiser where the backend needs it."""

    @abstractmethod
    def adopted_statistics(self, statistics: DensityStatistics) -> DensityStatistics:
        """Return the statistics where the backend needs them."""

    @abstractmethod
    def shown(self, photos: PhotoSource, view: int, divisor: int, window: Window | None) -> Shown:
        """Return a photo and its mask, whole or a window."""

    @abstractmethod
    def render(self, adam: Adam, camera: Camera, options: RenderOptions) -> Any:
        """Return a rendered view with the images ``color``, ``alpha``, ``depth`` and more."""

    @abstractmethod
    def compare_colors(
        self, image: Any, shown: Shown, lambda_dssim: float, *,
        exposure: tuple[Exposure, int] | None, background: np.ndarray | None, over_emptiness: bool,
    ) -> tuple[Any, ImageGradients, Any]:  # fmt: skip
        """Return the colour loss, its gradients on colour and alpha, and the mean squared error.

        Parameters
        ----------
        exposure : (Exposure, int), optional
            Exposures and the photo's index. The gradient is stored for ``Exposure.step`` once
            :meth:`numbers` was called.
        background : (3,), optional
            Colour behind render and masked pixels (:mod:`.background`).
        over_emptiness : bool
            Whether masked pixels are empty space.
        """

    @abstractmethod
    def normal_losses(
        self, image: Any, camera: Camera, shown: Shown, *, lambda_depth_normal: float,
        lambda_normal: float,
    ) -> tuple[Any, ImageGradients]:  # fmt: skip
        """Return the normal losses and their gradients on the images."""

    @abstractmethod
    def prior_loss(
        self, image: Any, camera: Camera, prior: DepthPrior, shown: Shown, weight: float
    ) -> tuple[Any, ImageGradients]:
        """Return the loss on confirmed depths and its gradient on the depth."""

    @abstractmethod
    def compare_views(
        self, image: Any, adam: Adam, camera: Camera, shown: Shown, other_camera: Camera,
        other: Shown, options: MultiViewOptions, random: np.random.Generator,
    ) -> tuple[Any, ImageGradients, Any]:  # fmt: skip
        """Return the multi-view losses, their gradients on the images, and those on the Gaussians
        through the other view (or ``None``)."""

    @abstractmethod
    def backward(self, image: Any, gradients: ImageGradients) -> Any:
        """Return the gradients on the Gaussians; statistics asked for are complete then."""

    @abstractmethod
    def add_priors(
        self, image: Any, gradients: Any, adam: Adam, price: float, opacity_weight: float
    ) -> None:
        """Add the gradients of footprint regulariser and opacity prior (weights 0: none)."""

    @abstractmethod
    def pose_gradient(self, camera: Camera, gradients: Any, adam: Adam) -> Any:
        """Return the (6,) gradient on the camera's pose."""

    @abstractmethod
    def merged(self, gradients: Any, other: Any, count: int) -> Any:
        """Return the sum of two gradients on ``count`` Gaussians."""

    @abstractmethod
    def add_statistics(
        self, statistics: DensityStatistics, image: Any, width: int, height: int, part: float
    ) -> None:
        """Accumulate the statistics of a view after its backward pass."""

    @abstractmethod
    def step(
        self, adam: Adam, gradients: Any, rates: Mapping[str, np.ndarray], sh_degree: int
    ) -> None:
        """Step the Gaussians that the view has seen."""

    @abstractmethod
    def numbers(self, *values: Any) -> list[np.ndarray]:
        """Return arrays or numbers of an iteration as numpy arrays; waits for the device once."""

    def use_less_memory(self) -> bool:
        """Free what can be freed and use smaller pieces from now on; return whether that is new."""
        return False

    def release(self) -> None:  # noqa: B027 - nothing to free is the usual case
        """Free memory that the next iteration does not need."""


def counts_of(mask: np.ndarray | None, height: int, width: int) -> tuple[int, int]:
    """Return the pixels that a mask leaves, and the SSIM windows centred on them."""
    if min(height, width) < WINDOW:
        return height * width if mask is None else int(np.count_nonzero(mask)), 0
    if mask is None:
        return height * width, (height - 2 * RADIUS) * (width - 2 * RADIUS)
    inner = mask[RADIUS : height - RADIUS, RADIUS : width - RADIUS]
    return int(np.count_nonzero(mask)), int(np.count_nonzero(inner))
