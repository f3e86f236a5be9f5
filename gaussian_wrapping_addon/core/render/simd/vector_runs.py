# SPDX-License-Identifier: GPL-3.0-or-later
"""Explicit vector instructions for numba kernels: runs of 8 or 16 float32, bits, prefetching.

Bounds are not checked: indices must be valid and not negative.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from ...kernels.compiled import inline
from .raster_math import ROW_VALUES


def _run_pointer(lanes: int, context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    """Return the LLVM pointer to the vector of ``lanes`` float32 at ``array[at]``."""
    data = context.make_array(kind)(context, builder, array).data
    vector = ir.VectorType(ir.FloatType(), lanes)
    return builder.bitcast(builder.gep(data, [at]), vector.as_pointer())


def _copy_intrinsic(lanes: int) -> Any:
    """Make a function that copies ``lanes`` float32 as one vector.

    Instead of a loop: between two arrays, or two variable offsets of one array, LLVM cannot prove
    that the runs do not overlap, and falls back to scalar code.
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


def _prefetch_intrinsic(locality: int) -> Any:
    """Make a function that prefetches a row: locality 3 for the L1 cache, 2 for L2."""

    @intrinsic
    def prefetch(typingctx, rows, row):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            data = context.make_array(sig.args[0])(context, builder, args[0]).data
            byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
            kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
            fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
            first = builder.mul(args[1], ir.Constant(args[1].type, ROW_VALUES))
            for offset in (0, ROW_VALUES - 1):  # 96 bytes lie on two cache lines
                pointer = builder.gep(data, [builder.add(first, ir.Constant(first.type, offset))])
                hints = [ir.Constant(word, value) for value in (0, locality, 1)]  # read, data
                builder.call(fetch, [builder.bitcast(pointer, byte), *hints])
            return context.get_dummy_value()

        return types.void(rows, types.intp), generate

    return prefetch


_prefetch_near, _prefetch_far = _prefetch_intrinsic(3), _prefetch_intrinsic(2)
_copy_8, _copy_16 = _copy_intrinsic(8), _copy_intrinsic(16)
_positive_8, _positive_16 = _mask_intrinsic(8), _mask_intrinsic(16)


@inline
def copy_run(lanes: Any, target: Any, target_at: Any, source: Any, source_at: Any) -> None:
    """Copy one run of 8 or 16 float32."""
    if lanes == 16:
        _copy_16(target, target_at, source, source_at)
    else:
        _copy_8(target, target_at, source, source_at)


@inline
def lowest_bit(bits: Any) -> Any:
    """Return the index of the lowest set bit of a uint64 other than 0."""
    return _lowest_bit(bits)  # type: ignore[call-arg]


@inline
def prefetch_row(rows: Any, row: Any) -> None:
    """Prefetch one row of a C-contiguous (n, 24) float32 array.

    Tiles access rows in an order that the processor cannot predict; waiting for them took a third
    of the time.
    """
    _prefetch_near(rows, row)


@inline
def prefetch_row_early(rows: Any, row: Any) -> None:
    """Prefetch a row that is read much later into the second-level cache."""
    _prefetch_far(rows, row)


@inline
def positive_run(lanes: Any, source: Any, source_at: Any) -> Any:
    """Return as bits which values of one run of 8 or 16 float32 are positive."""
    return _positive_16(source, source_at) if lanes == 16 else _positive_8(source, source_at)
