# SPDX-License-Identifier: GPL-3.0-or-later
"""Constants, exponentials and vector width of the raster kernels.

The kernels keep the state of a tile in *planes* of 256 values inside one float32 scratch array.
A plane is ordered by *blocks* of 8 or 16 pixels, 4 wide and 2 or 4 high, each of which is one
vector; blocks, and the pixels of a block, are numbered row by row.
"""

from __future__ import annotations

import functools
from typing import Any

import llvmlite.binding
import numba
import numpy as np

from ... import tolerances
from ...kernels.compiled import inline

TILE = tolerances.TILE_PX
PLANE = TILE * TILE
STRIDE = PLANE + TILE
"""Offset between planes. Not a divisor of 4096 bytes: loads would alias earlier stores."""
BLOCK_WIDTH = 4
BLOCK_COLUMNS = TILE // BLOCK_WIDTH
FEATURES = 9
ROW_VALUES = 24
"""Columns of params and of intersection gradients."""
# Planes of the forward scratch array.
TRANSMITTANCE, F0 = 0, 1
DEPTH, SLOPE = F0 + FEATURES, F0 + FEATURES + 1
BEST, BEST_AT = SLOPE + 1, SLOPE + 2
FORWARD_PLANES = BEST_AT + 1
PREFETCH_AHEAD = 8
"""Prefetch distance of rows, in intersections."""

ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
ALPHA_MIN = np.float32(tolerances.ALPHA_MIN)
ALPHA_MAX = np.float32(tolerances.ALPHA_MAX)
TRANSMITTANCE_MIN = np.float32(tolerances.TRANSMITTANCE_MIN)
ISO_LEVEL = np.float32(tolerances.ISO_LEVEL)
# No ray's den is smaller except by rounding; keeps 1 / den finite.
DENOMINATOR_MIN = np.float32(tolerances.DENOMINATOR_MIN)
FAR = np.float32(3e38)
FLOAT32_MAX = float(np.finfo(np.float32).max)
# Farther than this many sigma_z in front of its centre, a Gaussian's density is below 3e-7.
FRONT_SIGMAS = np.float32(5.5)
LIVENESS_EVERY = 32
"""Intersections between two updates of which blocks of a tile are not yet opaque."""

_LINE_VALUES = 16
# Pixels of a block relative to its first one.
LANE_X = (np.arange(TILE) % BLOCK_WIDTH).astype(np.float32)
LANE_Y = (np.arange(TILE) // BLOCK_WIDTH).astype(np.float32)

# exp(-y) on [0, 0.7] to 1e-7, fitted at Chebyshev nodes with relative weights; the constant term is
# exactly 1, so that exp(0) is 1.
FIT = np.array(
    [
        1.0,
        -0.9999997615814209,
        0.4999943971633911,
        -0.16662052273750305,
        0.04148262366652489,
        -0.00794854387640953,
        0.0009744596900418401,
    ],
    np.float32,
)
FIT_END = np.float32(0.7)
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = FIT
_EIGHTH, _THIRTY_SECOND = np.float32(1.0 / 8.0), np.float32(1.0 / 32.0)
WIDE_END = np.float32(32.0) * FIT_END
"""Where :func:`exp_wide` ends."""


@inline
def _exp_fit(y: Any) -> Any:
    """Return exp(-y) for 0 <= y <= 0.7."""
    return (((((_C6 * y + _C5) * y + _C4) * y + _C3) * y + _C2) * y + _C1) * y + _C0


@inline
def exp_short(x: Any) -> Any:
    """Return exp(-x) for 0 <= x <= 5.6, and less than 1/255 above (relative error 1.6e-6)."""
    p = _exp_fit(min(x * _EIGHTH, FIT_END))
    p = p * p
    p = p * p
    return p * p


@inline
def exp_wide(x: Any) -> Any:
    """Return exp(-x) for 0 <= x <= 22.4, and 0 above (relative error 7e-6).

    A small value instead of 0 would be amplified by the 1 / sigma^2 of thin Gaussians far behind.
    """
    p = _exp_fit(min(x * _THIRTY_SECOND, FIT_END))
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    return p if x <= WIDE_END else ZERO


@functools.lru_cache(maxsize=1)
def vector_lanes() -> int:
    """Return the number of pixels per block for the CPU that numba compiles for: 16 or 8."""
    # 16 where AVX-512 is compiled for.
    chosen = getattr(numba.config, "CPU_NAME", None)
    if chosen and chosen != llvmlite.binding.get_host_cpu_name():
        return 8
    features = llvmlite.binding.get_host_cpu_features()
    return 16 if features.get("avx512f") else 8


def aligned_zeros(count: int) -> np.ndarray:
    """Return ``count`` float32 aligned to a cache line, so that no vector spans two lines."""
    values = np.zeros(count + _LINE_VALUES, np.float32)
    offset = -(values.ctypes.data // values.itemsize) % _LINE_VALUES
    return values[offset : offset + count]
