# SPDX-License-Identifier: GPL-3.0-or-later
"""What training, baking and pictures ask of a scene's photos."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from .camera import Camera


class PhotoSource(Protocol):
    """Cameras, photos and masks of the scene's views at sizes divided by whole numbers.

    :class:`~.photos.photo_store.PhotoStore` is one.
    """

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera that fits ``photo(index, divisor)`` pixel for pixel."""

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return (h, w, 3) uint8."""

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        """Return (h, w) bool, true where the photo counts, or ``None``."""
