# SPDX-License-Identifier: GPL-3.0-or-later
"""Protocol of a source of photos, masks and matching cameras."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from .camera import Camera


class PhotoSource(Protocol):
    """Cameras, photos and masks of the scene's views, downsampled by integer divisors.

    Implemented by :class:`~.photos.photo_store.PhotoStore`.
    """

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera that fits ``photo(index, divisor)`` pixel for pixel."""

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return (h, w, 3) uint8."""

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        """Return (h, w) bool, true where the photo counts, or ``None``."""
