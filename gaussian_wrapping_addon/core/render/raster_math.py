# SPDX-License-Identifier: GPL-3.0-or-later
"""What the raster kernels share: constants, exponentials and vector width.

The kernels keep the state of a tile in *planes* of 256 values inside one float32 scratch array, and
walk it in *runs* of 8 or 16 neighbouring pixels of one row with constant trip count. Constant
offsets inside one array are what lets LLVM vectorise those loops (kernels.md 4.4 to 4.6).
"""

from __future__ import annotations

import functools
import math
from typing import Any

import llvmlite.binding
import numba
import numpy as np

from .. import tolerances
from ..compiled import inline

TILE = tolerances.TILE_PX
PLANE = TILE * TILE
FEATURES = 9
ROW_VALUES = 24
"""Columns of params and of pair gradients."""
PREFETCH_AHEAD = 8
"""Pairs between asking for a row and reading it."""

ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
ALPHA_MIN = np.float32(tolerances.ALPHA_MIN)
ALPHA_MAX = np.float32(tolerances.ALPHA_MAX)
TRANSMITTANCE_MIN = np.float32(tolerances.TRANSMITTANCE_MIN)
ISO_LEVEL = np.float32(tolerances.ISO_LEVEL)
# Rays that all but miss a Gaussian's half space: keeps 1 / den finite, distances huge.
DENOMINATOR_MIN = np.float32(1e-20)
FAR = np.float32(3e38)
# Beyond this many sigma_z before a Gaussian's centre its density is below 3e-7.
FRONT_SIGMAS = np.float32(5.5)
# alpha >= 1/255 holds within sqrt(2 ln 255) standard deviations only.
REACH_SIGMAS = np.float32(math.sqrt(2.0 * math.log(255.0)) + 0.01)
# The live rows of a tile are looked at again after this many Gaussians (a power of two).
LIVENESS_EVERY = 16

_LINE_VALUES = 16
COLUMN_OFFSETS = np.arange(TILE, dtype=np.float32)

# exp(-y) on [0, 0.7] to 1e-7, fitted at Chebyshev nodes with relative weights; the constant term is
# exactly 1, so that exp(0) is 1.
_C1, _C2 = np.float32(-0.9999997615814209), np.float32(0.4999943971633911)
_C3, _C4 = np.float32(-0.16662052273750305), np.float32(0.04148262366652489)
_C5, _C6 = np.float32(-0.00794854387640953), np.float32(0.0009744596900418401)
_FIT_END = np.float32(0.7)
_EIGHTH, _THIRTY_SECOND = np.float32(1.0 / 8.0), np.float32(1.0 / 32.0)


@inline
def _exp_fit(y: Any) -> Any:
    """Return exp(-y) for 0 <= y <= 0.7."""
    return (((((_C6 * y + _C5) * y + _C4) * y + _C3) * y + _C2) * y + _C1) * y + ONE


@inline
def exp_short(x: Any) -> Any:
    """Return exp(-x) for 0 <= x <= 5.6, and less than 1/255 above (relative error 1.6e-6)."""
    p = _exp_fit(min(x * _EIGHTH, _FIT_END))
    p = p * p
    p = p * p
    return p * p


@inline
def exp_wide(x: Any) -> Any:
    """Return exp(-x) for 0 <= x <= 22.4, and 2e-10 above (relative error 7e-6)."""
    p = _exp_fit(min(x * _THIRTY_SECOND, _FIT_END))
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    return p * p


@functools.lru_cache(maxsize=1)
def vector_lanes() -> int:
    """Return the run length that suits the CPU numba compiles for: 16 with AVX-512, else 8."""
    chosen = getattr(numba.config, "CPU_NAME", None)
    if chosen and chosen != llvmlite.binding.get_host_cpu_name():
        return 8
    features = llvmlite.binding.get_host_cpu_features()
    return 16 if features.get("avx512f") else 8


def aligned_zeros(count: int) -> np.ndarray:
    """Return ``count`` float32 that begin at a cache line, so that no vector spans two lines."""
    values = np.zeros(count + _LINE_VALUES, np.float32)
    offset = -(values.ctypes.data // values.itemsize) % _LINE_VALUES
    return values[offset : offset + count]
