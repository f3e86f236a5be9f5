# SPDX-License-Identifier: GPL-3.0-or-later
"""Large arrays are aligned to huge pages; small ones are ordinary arrays."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.parallel import empty_array

PAGE = 2**21


@pytest.mark.parametrize("dtype", [np.float32, np.bool_, np.int64])
@pytest.mark.parametrize("size", [PAGE // 2, PAGE, PAGE + 8, 5 * PAGE - 8])
def test_large_arrays_begin_at_a_page(dtype: type, size: int) -> None:
    count = size // np.dtype(dtype).itemsize
    array = empty_array(count, dtype)
    assert array.shape == (count,)
    assert array.dtype == dtype
    assert array.flags.c_contiguous
    assert array.flags.writeable
    assert array.ctypes.data % PAGE == 0
    array[:] = 1
    assert array.all()


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_small_arrays(count: int) -> None:
    array = empty_array(count, np.float32)
    assert array.shape == (count,)
    assert array.dtype == np.float32
