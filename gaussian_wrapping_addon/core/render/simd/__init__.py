# SPDX-License-Identifier: GPL-3.0-or-later
"""Explicit vectors of 8 or 16 float32 inside numba kernels.

In: float32 arrays and offsets. Out: vectors, masks, exponentials. Used by every raster kernel; also
their common constants.
"""
