# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory for large arrays, where the system can put it on large pages."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

_PAGE_BYTES = 1 << 21
"""A large page of x86 and of ARM with pages of 4 kB."""
_LARGE_BYTES = 1 << 19
"""Arrays from this size on; below, a large page would mostly be empty."""
_ADVISED_BYTES = 1 << 22
"""From this size on numpy asks Linux for large pages."""


def empty_array(count: int, dtype: DTypeLike) -> np.ndarray:
    """Return a one-dimensional array with any content, a large one on pages of 2 MiB.

    Raster kernels read rows of Gaussians in no order; where these lie on pages of 4 kB, blending
    takes a third longer. Memory beyond the array is reserved, not used, except for the last page.
    """
    kind = np.dtype(dtype)
    size = count * kind.itemsize
    if size < _LARGE_BYTES:
        return np.empty(count, kind)
    # One page to begin at the boundary of one, and whole pages up to the end.
    reserved = -(-size // _PAGE_BYTES) * _PAGE_BYTES + _PAGE_BYTES
    memory = np.empty(max(reserved, _ADVISED_BYTES), np.uint8)
    first = -memory.ctypes.data % _PAGE_BYTES
    return memory[first : first + size].view(kind)
