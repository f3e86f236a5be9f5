# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a scene as 8-bit arrays at every level of a pyramid, within a memory bound."""

from __future__ import annotations

import dataclasses
import threading
from collections import OrderedDict
from collections.abc import Callable

import numpy as np

from ...errors import DatasetError
from ..camera import Camera
from ..scene import Scene
from .photo_file import MASK_THRESHOLD, photo_header, read_mask, read_photo

DEFAULT_MEMORY_BYTES = 1 << 30


class PhotoStore:
    """Photos, masks and matching cameras of a scene's views, read on demand and cached.

    The base level (divisor 1) is the photo with its long side limited to ``max_image_px``;
    divisor d averages d x d base pixels and crops incomplete blocks at the right and lower border,
    so that the camera of a level is exactly the base camera with intrinsics divided by d.
    Thread-safe.

    Parameters
    ----------
    scene : Scene
    max_image_px : int
        Long side of the base level, pixels.
    memory_bytes : int
        Limit of the cache; one photo is kept even if it alone is larger.
    """

    def __init__(
        self, scene: Scene, max_image_px: int, *, memory_bytes: int = DEFAULT_MEMORY_BYTES
    ) -> None:
        self._views = scene.views
        self._memory_bytes = memory_bytes
        self._lock = threading.Lock()
        self._cache: OrderedDict[tuple[str, int, int], np.ndarray] = OrderedDict()
        self._cached_bytes = 0
        self._base = [_base_camera(view.camera, max_image_px) for view in scene.views]

    def __len__(self) -> int:
        return len(self._views)

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera that fits ``photo(index, divisor)`` pixel for pixel."""
        base = self._base[index]
        width, height = base.width // divisor, base.height // divisor
        if width < 1 or height < 1:
            raise ValueError(f"divisor {divisor} leaves nothing of {base.width} x {base.height}")
        return dataclasses.replace(
            base,
            width=width,
            height=height,
            fx=base.fx / divisor,
            fy=base.fy / divisor,
            cx=base.cx / divisor,
            cy=base.cy / divisor,
        )

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return the photo at a level.

        Returns
        -------
        (h, w, 3) uint8
            Read-only.

        Raises
        ------
        DatasetError
            The file was changed or removed after the scene was made.
        """
        return self._cached(("photo", index, divisor), lambda: self._make_photo(index, divisor))

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        """Return the mask at a level, (h, w) bool, true where the photo counts; or ``None``."""
        if self._views[index].mask_path is None:
            return None
        return self._cached(("mask", index, divisor), lambda: self._make_mask(index, divisor))

    def _make_photo(self, index: int, divisor: int) -> np.ndarray:
        if divisor > 1:
            return _average(self.photo(index), divisor)
        view, base = self._views[index], self._base[index]
        self._check_size(view.photo_path, view.camera)
        # Photos of a scene are stored upright: none relies on an EXIF rotation.
        color = read_photo(view.photo_path, upright=False).color
        if (base.width, base.height) == (view.camera.width, view.camera.height):
            return color
        from PIL import Image

        # Lanczos with its support scaled to the reduction: no aliasing, no shift of the grid.
        size = (base.width, base.height)
        return np.array(Image.fromarray(color).resize(size, Image.Resampling.LANCZOS))

    def _make_mask(self, index: int, divisor: int) -> np.ndarray:
        view, base = self._views[index], self._base[index]
        assert view.mask_path is not None
        if divisor > 1:
            full = self.mask(index)
            assert full is not None
            grey = np.where(full, 255, 0).astype(np.uint8)[..., None]
            return _average(grey, divisor)[..., 0] >= MASK_THRESHOLD
        self._check_size(view.mask_path, view.camera)
        grey = read_mask(view.mask_path, upright=False)
        if grey.shape != (base.height, base.width):
            from PIL import Image

            size = (base.width, base.height)
            grey = np.asarray(Image.fromarray(grey).resize(size, Image.Resampling.BOX))
        return grey >= MASK_THRESHOLD

    @staticmethod
    def _check_size(path: object, camera: Camera) -> None:
        from pathlib import Path

        header = photo_header(Path(str(path)))
        if (header.width, header.height) != (camera.width, camera.height):
            raise DatasetError(
                f"{Path(str(path)).name} is now {header.width} x {header.height} pixels, it was "
                f"{camera.width} x {camera.height}.",
                "Put the photo back, or start the job anew.",
            )

    def _cached(self, key: tuple[str, int, int], make: Callable[[], np.ndarray]) -> np.ndarray:
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        made = make()  # outside the lock: decoding is slow, and levels call for the base
        made.setflags(write=False)
        with self._lock:
            if key not in self._cache:
                self._cache[key] = made
                self._cached_bytes += made.nbytes
                while self._cached_bytes > self._memory_bytes and len(self._cache) > 1:
                    _, dropped = self._cache.popitem(last=False)
                    self._cached_bytes -= dropped.nbytes
            return self._cache[key]


def _base_camera(camera: Camera, max_image_px: int) -> Camera:
    factor = max_image_px / max(camera.width, camera.height)
    if factor >= 1.0:
        return camera
    width, height = round(camera.width * factor), round(camera.height * factor)
    return camera.resized(max(1, width), max(1, height))


def _average(pixels: np.ndarray, divisor: int) -> np.ndarray:
    """Average blocks of (h, w, c) uint8 pixels, rounding to nearest."""
    height, width = pixels.shape[0] // divisor, pixels.shape[1] // divisor
    cut = pixels[: height * divisor, : width * divisor]
    blocks = cut.reshape(height, divisor, width, divisor, -1)
    total = blocks.sum((1, 3), dtype=np.uint32)  # (height, width, c)
    area = divisor * divisor
    return ((total + area // 2) // area).astype(np.uint8)
