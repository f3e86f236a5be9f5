# SPDX-License-Identifier: GPL-3.0-or-later
"""Arrays of photos kept in memory, up to a number of bytes, for readers that come round again."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator

import numpy as np

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

    Parameters
    ----------
    limit_bytes : int
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

        Returns
        -------
        array : ndarray
            The same, or that of another thread that was first.
        left_out : list of (Key, ndarray)
            What does not stay for later: what had to make room, or the array itself.
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
