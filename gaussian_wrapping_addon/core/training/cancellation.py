# SPDX-License-Identifier: GPL-3.0-or-later
"""Cancelling inside the loops of a training that look at many views for one iteration."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

import numpy as np

from ..dataset.camera import Camera
from ..dataset.photo_source import PhotoSource
from ..progress import Progress

Item = TypeVar("Item")


def cancellable(items: Iterable[Item], progress: Progress) -> Iterator[Item]:
    """Yield the items, asking for cancelling before each one is made.

    A wrapping round renders up to sixty views, which takes longer than the two seconds within
    which a cancelled job stops. Where such a loop changes the state of a training only after its
    last view, ending it early leaves the state as it was before.

    Raises
    ------
    Cancelled
        Before the item after the request is asked for.
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
    """Photos that ask for cancelling whenever one is fetched.

    For what looks at all photos before the first iteration, or after the last.
    """

    def __init__(self, photos: PhotoSource, progress: Progress) -> None:
        self._photos, self._progress = photos, progress

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera of a level."""
        return self._photos.camera(index, divisor)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return (h, w, 3) uint8, or raise :class:`~.errors.Cancelled`."""
        self._progress.check()
        return self._photos.photo(index, divisor)

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        """Return (h, w) bool or ``None``, or raise :class:`~.errors.Cancelled`."""
        self._progress.check()
        return self._photos.mask(index, divisor)
