# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory for large arrays, aligned so that the system can use huge pages."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

_PAGE_BYTES = 1 << 21
"""A huge page of x86, and of ARM with 4 kB pages."""
_LARGE_BYTES = 1 << 19
"""Smallest array to align; for smaller ones a huge page would be mostly empty."""
_ADVISED_BYTES = 1 << 22
"""Allocation size from which numpy requests huge pages from Linux."""


def empty_array(count: int, dtype: DTypeLike) -> np.ndarray:
    """Return an uninitialised one-dimensional array, a large one on pages of 2 MiB.

    Raster kernels access rows of Gaussians in random order; with pages of 4 kB, blending takes a
    third longer. Memory beyond the array is reserved but not used, except for the last page.
    """
    kind = np.dtype(dtype)
    size = count * kind.itemsize
    if size < _LARGE_BYTES:
        return np.empty(count, kind)
    # One page for alignment, and whole pages up to the end.
    reserved = -(-size // _PAGE_BYTES) * _PAGE_BYTES + _PAGE_BYTES
    memory = np.empty(max(reserved, _ADVISED_BYTES), np.uint8)
    first = -memory.ctypes.data % _PAGE_BYTES
    return memory[first : first + size].view(kind)
