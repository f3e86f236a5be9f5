# SPDX-License-Identifier: GPL-3.0-or-later
"""Grey levels of colours."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.resampling import LUMA, grey_of


def test_grey_levels_of_the_primaries_and_of_white() -> None:
    colors = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    grey = grey_of(colors)
    assert grey.dtype == np.float32
    assert grey == pytest.approx(np.array([[76.245, 149.685], [29.07, 255.0]]), rel=1e-6)
    assert sum(LUMA) == pytest.approx(1.0)
