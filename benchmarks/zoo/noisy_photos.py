# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos with noise: those of the zoo have none, those of cameras do."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene import Scene


class NoisyPhotos(PhotoStore):
    """A photo store whose photos get white noise, at full size, before they are made smaller.

    Parameters
    ----------
    scene, max_image_px
        As for :class:`PhotoStore`.
    noise : float
        Standard deviation in grey levels, of each channel.
    """

    def __init__(self, scene: Scene, max_image_px: int, noise: float) -> None:
        super().__init__(scene, max_image_px)
        self._noise = noise

    def _make_photo(self, index: int, divisor: int) -> np.ndarray:
        photo = super()._make_photo(index, divisor)
        if divisor > 1 or self._noise == 0.0:
            return photo  # made from the full size
        random = np.random.default_rng([17, index])
        noisy = photo + self._noise * random.normal(size=photo.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
