# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos with noise, and compressed ones: those of the zoo are neither, those of cameras are."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene import Scene

from .taken_photos import compressed


class NoisyPhotos(PhotoStore):
    """A photo store whose photos get white noise and are compressed, at full size.

    Parameters
    ----------
    scene, max_image_px
        As for :class:`PhotoStore`.
    noise : float
        Standard deviation in grey levels, of each channel.
    jpeg_quality : int
        0: not compressed.
    """

    def __init__(
        self, scene: Scene, max_image_px: int, noise: float, jpeg_quality: int = 0
    ) -> None:
        super().__init__(scene, max_image_px)
        self._noise, self._jpeg_quality = noise, jpeg_quality

    def _make_photo(self, index: int, divisor: int) -> np.ndarray:
        photo = super()._make_photo(index, divisor)
        if divisor > 1:
            return photo  # made from the full size
        random = np.random.default_rng([17, index])
        noisy = photo + self._noise * random.normal(size=photo.shape)
        photo = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        return compressed(photo, self._jpeg_quality) if self._jpeg_quality else photo
