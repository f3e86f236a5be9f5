# SPDX-License-Identifier: GPL-3.0-or-later
"""A file without a name that holds decoded photos: quicker to read again than to decode again."""

from __future__ import annotations

import logging
import shutil
import tempfile
import threading
from pathlib import Path
from typing import IO

import numpy as np

from ...limits import DECODED_PHOTOS_DISK_SHARE
from .kept_photos import Key

_logger = logging.getLogger(__name__)


class DecodedFile:
    """Arrays of photos in a temporary file, which goes with the process however that ends.

    A file that cannot be written (a full disk, a folder without write access) is given up with a
    line in the log; photos are then decoded each time they are needed. Thread-safe.

    Parameters
    ----------
    folder : Path
        On the file system to write to. No entry appears in it.
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
                    self._begin()
                assert self._file is not None
                if self.bytes_written + array.nbytes > self._limit_bytes:
                    return
                self._file.seek(self.bytes_written)
                _write(self._file, np.ascontiguousarray(array))
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
                if _read(self._file, array):
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

    def _begin(self) -> None:
        self._limit_bytes = int(DECODED_PHOTOS_DISK_SHARE * shutil.disk_usage(self._folder).free)
        # Unlinked at once, or removed by Windows when the last handle goes: nothing can be left.
        self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115

    def _end(self) -> None:
        self._is_open = False
        self._places.clear()
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as error:
                _logger.debug("closing decoded photos: %s", error)


def _bytes_of(array: np.ndarray) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _write(file: IO[bytes], array: np.ndarray) -> None:
    left = _bytes_of(array)
    while len(left):
        left = left[file.write(left) :]


def _read(file: IO[bytes], array: np.ndarray) -> bool:
    """Fill an array; return whether the file had enough."""
    left = _bytes_of(array)
    while len(left):
        count = file.readinto(left)  # type: ignore[attr-defined]
        if not count:
            return False
        left = left[count:]
    return True
