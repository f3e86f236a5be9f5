# SPDX-License-Identifier: GPL-3.0-or-later
"""Named arrays whose memory is reused between calls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike

from .huge_pages import empty_array

# A buffer that has to grow is over-allocated by this share, so that slowly growing sets of
# Gaussians do not allocate in every iteration.
_GROWTH = 0.25


class ArrayStore:
    """Arrays by name, reused as long as they are large enough; not thread-safe.

    An array is valid until its name is taken again. Fresh memory from the system costs a page fault
    every 4 kB, which for the arrays of a rendering adds up to milliseconds.
    """

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}

    def take(
        self, name: str, shape: tuple[int, ...] | int, dtype: DTypeLike, limit: int | None = None
    ) -> np.ndarray:
        """Return an uninitialised C-contiguous array.

        Parameters
        ----------
        name : str
            A name has one dtype and one shape after the first axis.
        shape, dtype
            As for :func:`numpy.empty`.
        limit : int, optional
            Largest number of rows to reserve ahead of need.
        """
        shape = (shape,) if isinstance(shape, int) else shape
        kept = self._kept.get(name)
        size = math.prod(shape)
        if kept is None or len(kept) < size or kept.dtype != np.dtype(dtype):
            # Free the old memory before allocating the new.
            self._kept.pop(name, None)
            kept = None
            rows, row_size = shape[0], math.prod(shape[1:])
            reserved = rows + int(_GROWTH * rows)
            if limit is not None:
                reserved = max(rows, min(reserved, limit))
            kept = empty_array(reserved * row_size, dtype)
            self._kept[name] = kept
        return kept[:size].reshape(shape)

    def zeros(self, name: str, shape: tuple[int, ...] | int, dtype: DTypeLike) -> np.ndarray:
        """Return an array like :meth:`take`, filled with 0."""
        array = self.take(name, shape, dtype)
        array.fill(0)
        return array

    def names(self) -> list[str]:
        """Return the names of the stored arrays."""
        return list(self._kept)

    def nbytes(self, *names: str) -> int:
        """Return the total size of these arrays; names never taken count 0."""
        return sum(self._kept[name].nbytes for name in names if name in self._kept)
