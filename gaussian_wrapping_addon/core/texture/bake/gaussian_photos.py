# SPDX-License-Identifier: GPL-3.0-or-later
"""Renderings of the Gaussians as a replacement for photos in baking, rendered on demand."""

from __future__ import annotations

import numpy as np
import torch

from ...dataset.camera import Camera
from ...dataset.photo_source import PhotoSource
from ...gaussians.model import OrientedGaussians
from ...render.render import render
from ...render.types.options import RenderOptions

MIN_ALPHA = 0.5
"""Below this opacity there is no surface to take a colour from."""


class GaussianPhotos:
    """Diffuse colour of Gaussians from the cameras of photos (docs/method.md, section 8.4).

    Only harmonics of degree 0: highlights and other view-dependent effects are left out, and so are
    objects in single photos. The detail is that of the Gaussians. Only the last rendering is
    cached.

    Parameters
    ----------
    gaussians : OrientedGaussians
        In the scene frame.
    photos : PhotoStore
        Source of cameras and masks.
    threads : int
        The result does not depend on it.
    """

    def __init__(self, gaussians: OrientedGaussians, photos: PhotoSource, *, threads: int) -> None:
        self._gaussians = gaussians
        self._photos = photos
        self._options = RenderOptions(depth=False, sh_degree=0, threads=threads)
        self._last: tuple[tuple[int, int], np.ndarray, np.ndarray] | None = None

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera of a photo at a level."""
        return self._photos.camera(index, divisor)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return the (h, w, 3) uint8 rendering at a level, opaque where not masked."""
        return self._rendered(index, divisor)[0]

    def mask(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return (h, w) bool: inside the photo's mask and covered by the Gaussians."""
        covered = self._rendered(index, divisor)[1]
        mask = self._photos.mask(index, divisor)
        return covered if mask is None else covered & mask

    def _rendered(self, index: int, divisor: int) -> tuple[np.ndarray, np.ndarray]:
        wanted = (index, divisor)
        if self._last is None or self._last[0] != wanted:
            camera = self._photos.camera(index, divisor)
            with torch.no_grad():
                image = render(self._gaussians, camera, self._options)
            alpha = image.alpha.numpy().reshape(camera.height, camera.width, 1)
            color = image.color.numpy() / np.maximum(alpha, MIN_ALPHA)
            pixels = np.rint(255.0 * color.clip(0.0, 1.0)).astype(np.uint8)
            self._last = (wanted, pixels, alpha[..., 0] >= MIN_ALPHA)
        return self._last[1], self._last[2]
