# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a training, in memory as far as they fit, else decoded on disk."""

from __future__ import annotations

import dataclasses
import logging
import shutil
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from ..errors import DatasetError
from ..limits import (
    DECODED_PHOTOS_DISK_SHARE,
    MAX_PHOTO_MEMORY_BYTES,
    MIN_PHOTO_MEMORY_BYTES,
    PHOTO_MEMORY_SHARE,
    UNKNOWN_PHOTO_MEMORY_BYTES,
)
from ..machine import available_memory_bytes
from ..scene.camera import Camera
from ..scene.scene import PhotoSource, Scene
from .photo_file import MASK_THRESHOLD, photo_header, read_mask, read_photo

# -- How much memory decoded photos may take, and whether all of them fit -------------------------


def photo_budget_bytes(free_bytes: int) -> int:
    """Return the memory for decoded photos on a machine with so much free; 0 if unknown."""
    if not free_bytes:
        return UNKNOWN_PHOTO_MEMORY_BYTES
    share = int(PHOTO_MEMORY_SHARE * free_bytes)
    return max(MIN_PHOTO_MEMORY_BYTES, min(share, MAX_PHOTO_MEMORY_BYTES))


@dataclass(frozen=True)
class PhotoMemory:
    """Photos of a training, decoded, and the memory for them."""

    photos: int
    all_bytes: int
    """Of all photos and masks at the sizes at which they are trained on."""
    budget_bytes: int

    @property
    def fits(self) -> bool:
        """Whether all stay in memory once they were read."""
        return self.all_bytes <= self.budget_bytes

    @property
    def used_bytes(self) -> int:
        """Memory that decoded photos take at most."""
        return min(self.all_bytes, self.budget_bytes)

    def sentence(self) -> str:
        """Return in a few words where the photos are."""
        size = f"{self.all_bytes / 2**30:.2f} GB"
        if self.fits:
            return f"in memory, {size}"
        each = self.all_bytes / max(1, self.photos) / 2**20
        return (
            f"read on demand: {self.photos} of {each:.1f} MB decoded are {size}, "
            f"{self.budget_bytes / 2**30:.2f} GB of memory are for them"
        )


def photo_memory(photos: int, pixels: float, *, masked: bool, free_bytes: int) -> PhotoMemory:
    """Return what photos take that are read at three sizes, each half of the one before.

    Parameters
    ----------
    pixels : float
        Of a photo at the largest of them.
    masked : bool
    free_bytes : int
        Free memory of the machine; 0 if unknown.
    """
    all_bytes = round(photos * pixels * (4 if masked else 3) * (1 + 1 / 4 + 1 / 16))
    return PhotoMemory(photos, all_bytes, photo_budget_bytes(free_bytes))


# -- Arrays of photos kept in memory, up to a number of bytes, for readers that come round again

Key = tuple[str, int, int]
"""Kind of array, number of the photo, divisor of its size."""


class KeptPhotos:
    """Arrays of photos, of which those that fit stay.

    Training reads all photos in random order, epoch by epoch. Dropping what was used longest ago
    would then drop what comes next: with room for half of the photos 15 % of the accesses would
    find theirs (the probability that a product of two uniform numbers exceeds a half). Here an
    array that came while there was room stays, and half of them do.

    To make room, only these are dropped, those used longest ago first: arrays of a photo that was
    asked for at another size since; then arrays more than :data:`MUCH_LARGER` times as large, as
    many small ones save more reading than one large one. Beyond the limit, the array used last is
    kept, one of each kind. Thread-safe.
    """

    MUCH_LARGER = 2

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.bytes_kept = 0
        self._lock = threading.Lock()
        self._kept: OrderedDict[Key, np.ndarray] = OrderedDict()  # used longest ago first
        self._last: dict[str, tuple[Key, np.ndarray]] = {}
        self._wanted: dict[tuple[str, int], int] = {}
        """Divisor at which each photo was asked for last."""
        self._outdated: OrderedDict[Key, None] = OrderedDict()
        """Kept arrays of another divisor than that."""

    def get(self, key: Key) -> np.ndarray | None:
        """Return an array that is kept, or ``None``."""
        with self._lock:
            self._want(*key)
            if key in self._kept:
                self._kept.move_to_end(key)
            return self._found(key)

    def peek(self, key: Key) -> np.ndarray | None:
        """Return an array that is kept, or ``None``, as if nobody had asked for it."""
        with self._lock:
            return self._found(key)

    def put(self, key: Key, array: np.ndarray) -> tuple[np.ndarray, list[tuple[Key, np.ndarray]]]:
        """Keep an array that was asked for.

        Returns ``array``: the same, or that of another thread that was first; ``left_out``: what
        does not stay for later: what had to make room, or the array itself.
        """
        left_out: list[tuple[Key, np.ndarray]] = []
        with self._lock:
            known = self._kept.get(key)
            if known is not None:
                return known, left_out
            for victim in self._victims(array.nbytes):
                if self.bytes_kept + array.nbytes <= self.limit_bytes:
                    break
                left_out.append((victim, self._drop(victim)))
            if self.bytes_kept + array.nbytes <= self.limit_bytes:
                self._keep(key, array)
                self._last.pop(key[0], None)
            else:
                self._last[key[0]] = (key, array)
                left_out.append((key, array))
            return array, left_out

    def put_aside(self, key: Key, array: np.ndarray) -> bool:
        """Keep an array that nobody has asked for yet where nothing has to go for it."""
        with self._lock:
            if key in self._kept:
                return True
            if self.bytes_kept + array.nbytes > self.limit_bytes:
                return False
            self._keep(key, array)
            kind, index, divisor = key
            if self._wanted.get((kind, index), divisor) != divisor:
                self._outdated[key] = None
            return True

    def _found(self, key: Key) -> np.ndarray | None:
        if key in self._kept:
            return self._kept[key]
        last = self._last.get(key[0])
        return last[1] if last is not None and last[0] == key else None

    def _want(self, kind: str, index: int, divisor: int) -> None:
        before = self._wanted.get((kind, index))
        if before == divisor:
            return
        self._wanted[kind, index] = divisor
        if before is not None and (kind, index, before) in self._kept:
            self._outdated[kind, index, before] = None
        self._outdated.pop((kind, index, divisor), None)

    def _victims(self, size: int) -> Iterator[Key]:
        """Yield what may be dropped for an array of so many bytes."""
        if self.bytes_kept + size <= self.limit_bytes or size > self.limit_bytes:
            return
        yield from list(self._outdated)
        larger = self.MUCH_LARGER * size
        yield from [key for key, array in self._kept.items() if array.nbytes > larger]

    def _keep(self, key: Key, array: np.ndarray) -> None:
        self._kept[key] = array
        self.bytes_kept += array.nbytes

    def _drop(self, key: Key) -> np.ndarray:
        array = self._kept.pop(key)
        self.bytes_kept -= array.nbytes
        self._outdated.pop(key, None)
        return array


# -- A file without a name that holds decoded photos: quicker to read again than to decode again

_logger = logging.getLogger(__name__)


class DecodedFile:
    """Arrays of photos in a temporary file, which goes with the process however that ends.

    A file that cannot be written (a full disk, a folder without write access) is given up with a
    line in the log; photos are then decoded each time they are needed. Thread-safe.

    ``folder``: on the file system to write to. No entry appears in it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._file: IO[bytes] | None = None
        self._is_open = True
        self._places: dict[Key, tuple[int, tuple[int, ...], np.dtype]] = {}
        self._limit_bytes = 0
        self.bytes_written = 0

    def add(self, key: Key, array: np.ndarray) -> None:
        """Write an array, unless it is there or the file has its share of the disk."""
        with self._lock:
            if not self._is_open or key in self._places:
                return
            try:
                if self._file is None:
                    free = shutil.disk_usage(self._folder).free
                    self._limit_bytes = int(DECODED_PHOTOS_DISK_SHARE * free)
                    # Unlinked at once, or removed by Windows with the last handle: none is left.
                    self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
                if self.bytes_written + array.nbytes > self._limit_bytes:
                    return
                self._file.seek(self.bytes_written)
                if not _moved(np.ascontiguousarray(array), self._file.write):
                    raise OSError("nothing more can be written")
            except OSError as error:
                _logger.warning("decoded photos are not kept on disk: %s", error)
                self._end()
                return
            self._places[key] = (self.bytes_written, array.shape, array.dtype)
            self.bytes_written += array.nbytes

    def get(self, key: Key) -> np.ndarray | None:
        """Read an array, or return ``None`` where the file does not have it."""
        with self._lock:
            place = self._places.get(key)
            if place is None or self._file is None:
                return None
            begin, shape, dtype = place
            array = np.zeros(shape, dtype)
            try:
                self._file.seek(begin)
                if _moved(array, self._file.readinto):  # type: ignore[attr-defined]
                    return array
                reason: object = "it is shorter than it was"
            except OSError as error:
                reason = error
            _logger.warning("decoded photos on disk cannot be read: %s", reason)
            self._end()
            return None

    def close(self) -> None:
        """Remove the file."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        self._is_open = False
        self._places.clear()
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as error:
                _logger.debug("closing decoded photos: %s", error)


def _moved(array: np.ndarray, move: Callable[[memoryview], int]) -> bool:
    """Let ``move`` write or read the bytes of an array; return whether it moved all of them."""
    left = array.reshape(-1).view(np.uint8).data
    while len(left):
        count = move(left)
        if not count:
            return False
        left = left[count:]
    return True


# -- Photos of a scene as 8-bit arrays at every level of a pyramid, within a memory bound ---------


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
        Limit of the arrays kept (:class:`~.store.KeptPhotos`); by default a share of the
        memory that is free now (:func:`~.store.photo_budget_bytes`). The photo and the mask
        used last are kept beyond it.
    """

    def __init__(self, scene: Scene, max_image_px: int, *, memory_bytes: int | None = None) -> None:
        if memory_bytes is None:
            memory_bytes = photo_budget_bytes(available_memory_bytes())
        self._views = scene.views
        self._kept = KeptPhotos(memory_bytes)
        self.decoded: DecodedFile | None = None
        """Set by :func:`decoded_in`."""
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
            base, width=width, height=height, fx=base.fx / divisor, fy=base.fy / divisor,
            cx=base.cx / divisor, cy=base.cy / divisor,
        )  # fmt: skip

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return the photo at a level.

        Returns (h, w, 3) uint8, read-only.
        Raises DatasetError: the file was changed or removed after the scene was made.
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

    def _array(self, key: Key, make: Callable[[], np.ndarray]) -> np.ndarray:
        found = self._kept.get(key)
        if found is not None:
            return found
        array = self._made(key, make)  # without a lock: decoding is slow
        array, left_out = self._kept.put(key, array)
        if self.decoded is not None:
            for other, dropped in left_out:
                if other == key or other[2] == 1:  # other levels are made of that of divisor 1
                    self.decoded.add(other, dropped)
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
        if not self._kept.put_aside(key, array) and self.decoded is not None:
            self.decoded.add(key, array)
        return array

    def _made(self, key: Key, make: Callable[[], np.ndarray]) -> np.ndarray:
        array = None if self.decoded is None else self.decoded.get(key)
        if array is None:
            array = make()
        array.setflags(write=False)
        return array


@contextmanager
def decoded_in(photos: PhotoSource, folder: Path) -> Iterator[None]:
    """Keep decoded in a folder, in this context, what photos of files do not fit into memory.

    ``folder``: as for :class:`~.store.DecodedFile`.
    """
    if not isinstance(photos, PhotoStore):
        yield
        return
    before, now = photos.decoded, DecodedFile(folder)
    photos.decoded = now
    try:
        yield
    finally:
        now.close()
        photos.decoded = before


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
