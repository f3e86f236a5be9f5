# SPDX-License-Identifier: GPL-3.0-or-later
"""Grey levels of colours."""

from __future__ import annotations

import numpy as np

LUMA = (0.299, 0.587, 0.114)
"""Shares of red, green and blue in a grey level (ITU-R BT.601)."""


def grey_of(colors: np.ndarray) -> np.ndarray:
    """Return the grey levels (...) float32 of colours (..., 3) of any type, not rounded."""
    return np.asarray(colors @ np.array(LUMA, np.float32), np.float32)
