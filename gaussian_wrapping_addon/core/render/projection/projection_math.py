# SPDX-License-Identifier: GPL-3.0-or-later
"""Blocks of float64 for the projection kernels, with vectorisable exponential and logarithm.

Gaussians are projected in blocks of 8. Every value of a block is a *plane* of 8 float64 inside one
scratch array; loops over a block have a constant trip count, constant offsets in that one array
and no branches, which is what lets LLVM vectorise them. A partial block is padded with copies of
its last Gaussian, so that no value depends on its neighbours.

No vector math library is available, and one scalar call would prevent vectorisation, so the
exponential and the logarithm are polynomials (minimax in relative error, found with 50 digits).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from ...kernels.compiled import inline

BLOCK = 8
QUEUE = 256
"""Number of Gaussians left after culling that are collected before they are projected."""
_LINE_VALUES = 8  # float64 in a cache line

# exp(x) underflows to 0 below and overflows to infinity above; in between 2^n is a normal number.
_EXP_LOW, _EXP_HIGH = -708.0, 709.0
_LOG2_E = 1.0 / math.log(2.0)
# ln 2 in two parts; the first has 20 zero bits at its end, so that its multiples are exact.
_LN2_HIGH, _LN2_LOW = 0.6931471804855391, 7.440617110012397e-11
# Adding this rounds to an integer, which is then in the lowest bits.
_ROUNDER = 1.5 * 2.0**52
# (exp(r) - 1 - r) / r^2 for |r| <= ln(2) / 2; error of exp(r) - 1 is 5e-17 relative.
_E2, _E3, _E4, _E5 = 1 / 2, 1 / 6, 0.04166666666662412, 0.008333333333322207
_E6, _E7, _E8 = 0.0013888888917217457, 0.00019841269886591, 2.4801521290973345e-05
_E9, _E10, _E11 = 2.7557242336680357e-06, 2.7620090518499427e-07, 2.5110049895858716e-08
# (2 atanh(s) / s - 2) / s^2 by powers of s^2, for |s| <= tan(pi / 8)^2; error 5e-18.
_L0, _L1, _L2 = 0.666666666666667, 0.3999999999989789, 0.2857142862665141
_L3, _L4, _L5 = 0.22222211031749325, 0.18182896207631685, 0.15331497764506818
_L6 = 0.1461909699201228
_MANTISSA = (1 << 52) - 1
_EXPONENT_OF_ONE = 1023
_ONE_BITS = _EXPONENT_OF_ONE << 52
_ROUNDER_BITS = int(np.array(_ROUNDER).view(np.int64))
_ROUNDED_BIAS = _ROUNDER + _EXPONENT_OF_ONE
_SQRT_HALF_BITS = int(np.array(math.sqrt(0.5)).view(np.int64))


@intrinsic
def _bits_of(typingctx, value):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], ir.IntType(64))

    return types.int64(types.float64), generate


@intrinsic
def _float_of(typingctx, bits):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], ir.DoubleType())

    return types.float64(types.int64), generate


@inline
def exp_parts(x: Any) -> Any:
    """Return ``(s, p)`` with ``exp(x) = s + s p``, ``s`` a power of two and ``|p| < 0.42``.

    Right to 1e-15 relative where ``-708 <= x <= 709``; x is taken to these ends beyond them. NaN
    stays NaN. ``(s - 1) + s p`` is ``exp(x) - 1`` without cancellation.
    """
    y = _EXP_LOW if x < _EXP_LOW else x
    y = _EXP_HIGH if y > _EXP_HIGH else y
    shifted = y * _LOG2_E + _ROUNDER
    n = shifted - _ROUNDER
    r = (y - n * _LN2_HIGH) - n * _LN2_LOW
    p = (((_E11 * r + _E10) * r + _E9) * r + _E8) * r + _E7
    p = ((((p * r + _E6) * r + _E5) * r + _E4) * r + _E3) * r + _E2
    p = p * (r * r) + r
    scale: Any = _float_of((_bits_of(shifted) + _EXPONENT_OF_ONE) << 52)  # type: ignore[call-arg]
    return scale, p


@inline
def exp_wide(x: Any) -> Any:
    """Return exp(x) to 1e-15 relative, 0 below -708 and infinity above 709; NaN stays NaN."""
    scale, p = exp_parts(x)
    value = scale + scale * p
    value = 0.0 if x < _EXP_LOW else value
    return math.inf if x > _EXP_HIGH else value


@inline
def log_wide(x: Any) -> Any:
    """Return ln(x) for a positive normal x, to 4e-16 of the larger of 1 and the result."""
    # Mantissa in [sqrt(1/2), sqrt(2)); the exponent is converted via the lowest bits of a float.
    shifted: Any = _bits_of(x) - _SQRT_HALF_BITS  # type: ignore[call-arg]
    mantissa: Any = _float_of((shifted & _MANTISSA) + _SQRT_HALF_BITS)
    biased = (shifted + _ONE_BITS) >> 52
    whole: Any = _float_of(biased + _ROUNDER_BITS) - _ROUNDED_BIAS
    s = (mantissa - 1.0) / (mantissa + 1.0)
    z = s * s
    g = (((((_L6 * z + _L5) * z + _L4) * z + _L3) * z + _L2) * z + _L1) * z + _L0
    return whole * _LN2_HIGH + (whole * _LN2_LOW + (s * z * g + 2.0 * s))


@inline
def block_scratch(planes: Any) -> Any:
    """Return uninitialised planes of one block, aligned to a cache line."""
    values = np.empty(planes * BLOCK + _LINE_VALUES, np.float64)
    offset = -(values.ctypes.data >> 3) & (_LINE_VALUES - 1)
    return values[offset : offset + planes * BLOCK]
