# SPDX-License-Identifier: GPL-3.0-or-later
"""Contributor lists of the blocks of a tile, and which blocks are not yet opaque."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from ...kernels.compiled import inline
from ..simd.raster_math import PLANE, TILE, TRANSMITTANCE_MIN
from ..simd.simd import Block
from ..simd.vector_runs import lowest_bit

_GROUP = TILE
CONTRIBUTORS_PADDING = _GROUP
"""Values past the end of a list that may be overwritten."""
_WORD, _INDEX = ir.IntType(32), ir.IntType(64)


@intrinsic
def _pack_groups(typingctx, masks, begin, groups, block, contributors, at):  # type: ignore[no-untyped-def]
    """Write the intersections that reach a block to ``contributors[at ..]``; return their number.

    ``16 groups`` intersections are tested, sixteen per vector, which is compressed.
    """

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        words, bits = ir.VectorType(_WORD, _GROUP), ir.VectorType(ir.IntType(1), _GROUP)
        zeros, anything = ir.Constant(words, None), ir.Constant(words, ir.Undefined)

        def vector_at(argument: int, at: Any) -> Any:
            data = context.make_array(sig.args[argument])(context, builder, args[argument]).data
            return builder.bitcast(builder.gep(data, [at]), words.as_pointer())

        def repeated(value: Any) -> Any:
            one = builder.insert_element(anything, value, ir.Constant(_WORD, 0))
            return builder.shuffle_vector(one, one, zeros)

        _, begin_, groups_, block_, _, at_ = args
        steps = ir.Constant(words, [ir.Constant(_WORD, k) for k in range(_GROUP)])
        wanted = repeated(builder.shl(ir.Constant(_WORD, 1), builder.trunc(block_, _WORD)))
        kind = ir.FunctionType(words, [words, bits, words])
        name = f"llvm.experimental.vector.compress.v{_GROUP}i32"
        compress = cgutils.get_or_insert_function(builder.module, kind, name)
        end = cgutils.alloca_once_value(builder, at_)
        with cgutils.for_range(builder, groups_) as loop:
            first = builder.add(begin_, builder.mul(loop.index, ir.Constant(_INDEX, _GROUP)))
            own = builder.load(vector_at(0, first), align=4)
            reached = builder.icmp_unsigned("!=", builder.and_(own, wanted), zeros)
            intersections = builder.add(repeated(builder.trunc(first, _WORD)), steps)
            position = builder.load(end)
            packed = builder.call(compress, [intersections, reached, anything])
            builder.store(packed, vector_at(4, position), align=4)
            number = builder.ctpop(builder.bitcast(reached, ir.IntType(_GROUP)))
            builder.store(builder.add(position, builder.zext(number, _INDEX)), end)
        return builder.sub(builder.load(end), at_)

    index = types.intp
    return types.intp(masks, index, index, index, contributors, index), generate


@inline
def list_contributors(
    lanes: Any, masks: Any, begin: Any, count: Any, capacity: Any, contributors: Any, counts: Any
) -> None:
    """List, for each block, which intersections ``begin .. begin + count`` of a tile reach it.

    Parameters
    ----------
    lanes : int
        8 or 16.
    masks : (intersections,) uint32
    capacity : int
        Values of ``contributors`` per block, at least ``count + CONTRIBUTORS_PADDING``.
    contributors : (blocks * capacity,) int32
        Receives the intersections of block b, increasing, from ``b * capacity`` on.
    counts : (blocks,) int64
        Receives the length of each list.
    """
    blocks = PLANE // lanes
    if lanes == TILE:
        groups = count // _GROUP
        for block in range(blocks):
            at = block * capacity
            n = at + _pack_groups(masks, begin, groups, block, contributors, at)  # type: ignore[call-arg]
            for k in range(begin + groups * _GROUP, begin + count):
                contributors[n] = k
                n += np.int64((masks[k] >> np.uint32(block)) & np.uint32(1))
            counts[block] = n - at
    else:
        # Bit by bit, where no instruction compresses vectors.
        for block in range(blocks):
            counts[block] = 0
        for k in range(begin, begin + count):
            bits = np.uint64(masks[k])
            while bits != np.uint64(0):
                target = np.int64(lowest_bit(bits)) & (blocks - 1)
                contributors[target * capacity + counts[target]] = k
                counts[target] += 1
                bits &= bits - np.uint64(1)


def _active_intrinsic(lanes: int) -> Any:
    @intrinsic
    def active(typingctx, m, plane):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            block, bits = Block(lanes, context, builder), ir.Constant(_INDEX, 0)
            state = block.data(sig.args[0], args[0])
            for number in range(PLANE // lanes):
                transmittance = block.load(state, block.offset(args[1], number * lanes))
                passes = builder.zext((transmittance >= float(TRANSMITTANCE_MIN)).any(), _INDEX)
                bits = builder.or_(bits, builder.shl(passes, ir.Constant(_INDEX, number)))
            return bits

        return types.uint64(m, types.intp), generate

    return active


_active_16, _active_8 = _active_intrinsic(16), _active_intrinsic(8)


@inline
def active_blocks(lanes: Any, m: Any, plane: Any) -> Any:
    """Return as bits the blocks with a pixel that is not opaque; T is at ``m[plane ..]``."""
    return _active_16(m, plane) if lanes == 16 else _active_8(m, plane)
