# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a scene as 8-bit arrays at every level of a pyramid, within a memory bound."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ...errors import DatasetError
from ...machine import available_memory_bytes
from ..camera import Camera
from ..photo_source import PhotoSource
from ..scene import Scene
from .decoded_file import DecodedFile
from .kept_photos import KeptPhotos, Key
from .photo_budget import photo_budget_bytes
from .photo_file import MASK_THRESHOLD, photo_header, read_mask, read_photo


class PhotoStore:
    """Photos, masks and matching cameras of a scene's views, read on demand within a budget.

    The base level (divisor 1) is the photo with its long side limited to ``max_image_px``;
    divisor d averages d x d base pixels and crops incomplete blocks at the right and lower border,
    so that the camera of a level is exactly the base camera with intrinsics divided by d.
    What comes out does not depend on the budget. Thread-safe.

    Parameters
    ----------
    scene : Scene
    max_image_px : int
        Long side of the base level, pixels.
    memory_bytes : int, optional
        Limit of the arrays kept (:class:`~.kept_photos.KeptPhotos`); by default a share of the
        memory that is free now (:func:`~.photo_budget.photo_budget_bytes`). The photo and the mask
        used last are kept beyond it.
    """

    def __init__(self, scene: Scene, max_image_px: int, *, memory_bytes: int | None = None) -> None:
        if memory_bytes is None:
            memory_bytes = photo_budget_bytes(available_memory_bytes())
        self._views = scene.views
        self._kept = KeptPhotos(memory_bytes)
        self._decoded: DecodedFile | None = None
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
        return self._array(("photo", index, divisor), lambda: self._make_photo(index, divisor))

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        """Return the mask at a level, (h, w) bool, true where the photo counts; or ``None``."""
        if self._views[index].mask_path is None:
            return None
        return self._array(("mask", index, divisor), lambda: self._make_mask(index, divisor))

    def _make_photo(self, index: int, divisor: int) -> np.ndarray:
        if divisor > 1:
            return _average(self._base_array("photo", index, self._make_photo), divisor)
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
            full = self._base_array("mask", index, self._make_mask)
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
    def _check_size(path: Path, camera: Camera) -> None:
        header = photo_header(path)
        if (header.width, header.height) != (camera.width, camera.height):
            raise DatasetError(
                f"{path.name} is now {header.width} x {header.height} pixels, it was "
                f"{camera.width} x {camera.height}.",
                "Put the photo back, or start the job anew.",
            )

    @contextmanager
    def decoded_in(self, folder: Path) -> Iterator[None]:
        """Keep decoded on disk, in this context, what does not fit into memory.

        Parameters
        ----------
        folder : Path
            As for :class:`~.decoded_file.DecodedFile`.
        """
        before, self._decoded = self._decoded, DecodedFile(folder)
        try:
            yield
        finally:
            self._decoded.close()
            self._decoded = before

    def _array(self, key: Key, make: Callable[[], np.ndarray]) -> np.ndarray:
        found = self._kept.get(key)
        if found is not None:
            return found
        array = self._made(key, make)  # without a lock: decoding is slow
        array, left_out = self._kept.put(key, array)
        if self._decoded is not None:
            for other, dropped in left_out:
                if other == key or other[2] == 1:  # other levels are made of that of divisor 1
                    self._decoded.add(other, dropped)
        return array

    def _base_array(
        self, kind: str, index: int, make: Callable[[int, int], np.ndarray]
    ) -> np.ndarray:
        """Return a photo or mask of divisor 1 that a level is made of; others are likely to come.

        It is kept where that costs no other array its place.
        """
        key = (kind, index, 1)
        found = self._kept.peek(key)
        if found is not None:
            return found
        array = self._made(key, lambda: make(index, 1))
        if not self._kept.put_aside(key, array) and self._decoded is not None:
            self._decoded.add(key, array)
        return array

    def _made(self, key: Key, make: Callable[[], np.ndarray]) -> np.ndarray:
        array = None if self._decoded is None else self._decoded.get(key)
        if array is None:
            array = make()
        array.setflags(write=False)
        return array


@contextmanager
def decoded_in(photos: PhotoSource, folder: Path) -> Iterator[None]:
    """Keep photos decoded in a folder, in this context, where they are read from files at all."""
    if isinstance(photos, PhotoStore):
        with photos.decoded_in(folder):
            yield
    else:
        yield


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
