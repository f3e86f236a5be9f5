# SPDX-License-Identifier: GPL-3.0-or-later
"""What the raster kernels share: constants, exponentials, vector width and rows per pair.

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
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from .. import tolerances
from ..compiled import inline, kernel

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

# exp(-y) on [0, 0.7] to 2.6e-7, fitted at Chebyshev nodes with relative weights.
_A0, _A1, _A2 = (
    np.float32(0.9999999403953552),
    np.float32(-0.9999924302101135),
    np.float32(0.4998812675476074),
)
_A3, _A4, _A5 = (
    np.float32(-0.16596902906894684),
    np.float32(0.03976483270525932),
    np.float32(-0.005842492450028658),
)
# The same to 1e-7 with the constant term exactly 1, so that exp(0) is 1.
_B1, _B2, _B3 = (
    np.float32(-0.9999997615814209),
    np.float32(0.4999943971633911),
    np.float32(-0.16662052273750305),
)
_B4, _B5, _B6 = (
    np.float32(0.04148262366652489),
    np.float32(-0.00794854387640953),
    np.float32(0.0009744596900418401),
)
_FIT_END = np.float32(0.7)
_EIGHTH, _THIRTY_SECOND = np.float32(1.0 / 8.0), np.float32(1.0 / 32.0)


@inline
def exp_short(x: Any) -> Any:
    """Return exp(-x) for 0 <= x <= 5.6, and less than 1/255 above (relative error 2.1e-6)."""
    y = min(x * _EIGHTH, _FIT_END)
    p = ((((_A5 * y + _A4) * y + _A3) * y + _A2) * y + _A1) * y + _A0
    p = p * p
    p = p * p
    return p * p


@inline
def exp_wide(x: Any) -> Any:
    """Return exp(-x) for 0 <= x <= 22.4, and 2e-10 above (relative error 7e-6); exact at 0."""
    y = min(x * _THIRTY_SECOND, _FIT_END)
    p = (((((_B6 * y + _B5) * y + _B4) * y + _B3) * y + _B2) * y + _B1) * y + ONE
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


def _run_pointer(lanes: int, context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    """Return the LLVM pointer to the vector of ``lanes`` float32 at ``array[at]``."""
    data = context.make_array(kind)(context, builder, array).data
    vector = ir.VectorType(ir.FloatType(), lanes)
    return builder.bitcast(builder.gep(data, [at]), vector.as_pointer())


def _copy_intrinsic(lanes: int) -> Any:
    """Make a function that copies ``lanes`` float32 as one vector.

    A loop would not do: between two arrays, or two variable places of one array, LLVM cannot
    prove that the copies do not overlap and falls back to single values.
    """

    @intrinsic
    def copy(typingctx, target, target_at, source, source_at):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            source_run = _run_pointer(lanes, context, builder, sig.args[2], args[2], args[3])
            target_run = _run_pointer(lanes, context, builder, sig.args[0], args[0], args[1])
            builder.store(builder.load(source_run, align=4), target_run, align=4)
            return context.get_dummy_value()

        return types.void(target, types.intp, source, types.intp), generate

    return copy


def _reduce_intrinsic(lanes: int, operation: str) -> Any:
    """Make a function that returns the sum or the largest of ``lanes`` float32, none of them NaN.

    LLVM does not recognise a maximum in numba's loops as a reduction, and unrolls short sums.
    """

    @intrinsic
    def reduced(typingctx, source, source_at):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            run = _run_pointer(lanes, context, builder, sig.args[0], args[0], args[1])
            single, vector = ir.FloatType(), ir.VectorType(ir.FloatType(), lanes)
            first = [ir.Constant(single, 0.0)] if operation == "fadd" else []
            kind = ir.FunctionType(single, [value.type for value in first] + [vector])
            name = f"llvm.vector.reduce.{operation}.v{lanes}f32"
            reduce = cgutils.get_or_insert_function(builder.module, kind, name)
            values = [*first, builder.load(run, align=4)]
            return builder.call(reduce, values, fastmath=("nnan", "nsz", "reassoc"))

        return types.float32(source, types.intp), generate

    return reduced


def _mask_intrinsic(lanes: int) -> Any:
    """Make a function that returns as bits which of ``lanes`` float32 are positive."""

    @intrinsic
    def positive(typingctx, source, source_at):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            run = _run_pointer(lanes, context, builder, sig.args[0], args[0], args[1])
            zeros = ir.Constant(ir.VectorType(ir.FloatType(), lanes), None)
            above = builder.fcmp_ordered(">", builder.load(run, align=4), zeros)
            bits = builder.bitcast(above, ir.IntType(lanes))
            return builder.zext(bits, ir.IntType(64))

        return types.uint64(source, types.intp), generate

    return positive


@intrinsic
def _lowest_bit(typingctx, bits):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate


@intrinsic
def _prefetch_row(typingctx, rows, row):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        first = builder.mul(args[1], ir.Constant(args[1].type, ROW_VALUES))
        for offset in (0, ROW_VALUES - 1):  # 96 bytes lie on two cache lines
            place = builder.gep(data, [builder.add(first, ir.Constant(first.type, offset))])
            hints = [ir.Constant(word, value) for value in (0, 3, 1)]  # read, keep, data
            builder.call(fetch, [builder.bitcast(place, byte), *hints])
        return context.get_dummy_value()

    return types.void(rows, types.intp), generate


_copy_8, _copy_16 = _copy_intrinsic(8), _copy_intrinsic(16)
_max_8, _max_16 = _reduce_intrinsic(8, "fmax"), _reduce_intrinsic(16, "fmax")
_sum_16 = _reduce_intrinsic(16, "fadd")
_positive_8, _positive_16 = _mask_intrinsic(8), _mask_intrinsic(16)


@inline
def copy_run(lanes: Any, target: Any, target_at: Any, source: Any, source_at: Any) -> None:
    """Copy one run of 8 or 16 float32; no bounds are checked."""
    if lanes == 16:
        _copy_16(target, target_at, source, source_at)
    else:
        _copy_8(target, target_at, source, source_at)


@inline
def max_run(lanes: Any, source: Any, source_at: Any) -> Any:
    """Return the largest value of one run of 8 or 16 float32; no bounds are checked."""
    return _max_16(source, source_at) if lanes == 16 else _max_8(source, source_at)


@inline
def lowest_bit(bits: Any) -> Any:
    """Return the place of the lowest bit of a uint64 that is not 0."""
    return _lowest_bit(bits)  # type: ignore[call-arg]


@inline
def prefetch_row(rows: Any, row: Any) -> None:
    """Ask for one row of a C-contiguous (n, 24) float32 array to be brought to the cache.

    Tiles visit rows in no order that the processor could guess; waiting for them took a third of
    the time.
    """
    _prefetch_row(rows, row)  # type: ignore[call-arg]


@inline
def sum_columns(source: Any, source_at: Any) -> Any:
    """Return the sum of 16 float32; no bounds are checked."""
    return _sum_16(source, source_at)


@inline
def positive_run(lanes: Any, source: Any, source_at: Any) -> Any:
    """Return as bits which values of one run of 8 or 16 float32 are positive."""
    return _positive_16(source, source_at) if lanes == 16 else _positive_8(source, source_at)


@kernel(fast=False)
def narrow_rows(
    first_tile: int,
    end_tile: int,
    start: np.ndarray,
    gaussian_ids: np.ndarray,
    ranges: np.ndarray,
    boxes: np.ndarray,
    skews: np.ndarray,
    tiles_x: int,
    rows: np.ndarray,
) -> None:
    """Write first and last row, within the tile, that each pair's ellipse reaches.

    ``rows (pairs, 2) uint8`` holds (1, 0) where there is none. The ellipse cut by the strip of the
    tile's columns spans rows between its own lowest and highest points or the strip's edges.
    """
    for tile in range(first_tile, end_tile):
        top = tile // tiles_x * TILE
        left = tile % tiles_x * TILE
        for k in range(start[tile], start[tile + 1]):
            i = gaussian_ids[k]
            first = max(ranges[i, 0] - top, 0)
            last = min(ranges[i, 1] - top, TILE - 1)
            clipped = ranges[i, 2] < left or ranges[i, 3] >= left + TILE
            if clipped and first < last and not math.isinf(skews[i]):
                x0, y0 = float(boxes[i, 0]), float(boxes[i, 1])
                x1, y1 = float(boxes[i, 2]), float(boxes[i, 3])
                half_x, half_y = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
                if half_x > 0.0 and half_y > 0.0:
                    inverse = 1.0 / half_x
                    center_x, center_y = 0.5 * (x1 + x0), 0.5 * (y1 + y0)
                    # At x = t half_x the ellipse spans slope t +- across sqrt(1 - t^2) in y.
                    begin = max((left + 0.5 - _STRIP_MARGIN - center_x) * inverse, -1.0)
                    end = min((left + TILE - 0.5 + _STRIP_MARGIN - center_x) * inverse, 1.0)
                    if begin > end:
                        first, last = 1, 0
                    else:
                        slope = float(skews[i]) * half_y * inverse
                        extreme = slope / half_y
                        across = math.sqrt(max(half_y * half_y * (1.0 + 1e-6) - slope * slope, 0.0))
                        t = min(max(extreme, begin), end)
                        bottom = slope * t + across * math.sqrt(max(1.0 - t * t, 0.0))
                        t = min(max(-extreme, begin), end)
                        upper = slope * t - across * math.sqrt(max(1.0 - t * t, 0.0))
                        margin = _STRIP_MARGIN + 1e-6 * half_y
                        low = np.ceil(center_y + upper - margin - 0.5) - top
                        high = np.floor(center_y + bottom + margin - 0.5) - top
                        if not (low <= last and high >= first):
                            first, last = 1, 0
                        else:
                            first = max(first, int(max(low, 0.0)))
                            last = min(last, int(min(high, TILE - 1.0)))
            if first > last:
                first, last = 1, 0
            rows[k, 0] = first
            rows[k, 1] = last


# Rounding of the float32 boxes and skews that rows are computed from, pixels.
_STRIP_MARGIN = 0.02
