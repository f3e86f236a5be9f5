# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos whose cameras have refined poses."""

from __future__ import annotations

import numpy as np

from ...dataset.camera import Camera
from ...dataset.photo_source import PhotoSource
from .camera_poses import CameraPoses


class PosedPhotos:
    """Photo source whose cameras follow the poses of a training.

    Parameters
    ----------
    photos : PhotoSource
        With the given cameras.
    """

    def __init__(self, photos: PhotoSource) -> None:
        self._photos = photos
        self.poses: CameraPoses | None = None
        """Poses to follow; ``None``: those given."""

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera at a pyramid level."""
        camera = self._photos.camera(index, divisor)
        return camera if self.poses is None else self.poses.camera(index, camera)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return (h, w, 3) uint8."""
        return self._photos.photo(index, divisor)

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        """Return (h, w) bool or ``None``."""
        return self._photos.mask(index, divisor)
