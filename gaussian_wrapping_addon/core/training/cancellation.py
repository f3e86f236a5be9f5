# SPDX-License-Identifier: GPL-3.0-or-later
"""Cancellation inside the loops of a training that render many views per iteration."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

import numpy as np

from ..dataset.camera import Camera
from ..dataset.photo_source import PhotoSource
from ..progress import Progress

Item = TypeVar("Item")


def cancellable(items: Iterable[Item], progress: Progress) -> Iterator[Item]:
    """Yield the items, checking for cancellation before each one is made.

    A wrapping round renders all training views, which takes longer than the two seconds within
    which a cancelled job stops. A loop that changes the training state only after its last view
    leaves the state unchanged when it ends early.

    Raises
    ------
    Cancelled
        Before the next item, once cancellation was requested.
    """
    iterator = iter(items)
    while True:
        progress.check()
        try:
            item = next(iterator)
        except StopIteration:
            return
        yield item


class CancellablePhotos:
    """Photo source that checks for cancellation on every access.

    For loops over all photos before the first iteration or after the last.
    """

    def __init__(self, photos: PhotoSource, progress: Progress) -> None:
        self._photos, self._progress = photos, progress

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera at a pyramid level."""
        return self._photos.camera(index, divisor)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return (h, w, 3) uint8, or raise :class:`~.errors.Cancelled`."""
        self._progress.check()
        return self._photos.photo(index, divisor)

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        """Return (h, w) bool or ``None``, or raise :class:`~.errors.Cancelled`."""
        self._progress.check()
        return self._photos.mask(index, divisor)
