# SPDX-License-Identifier: GPL-3.0-or-later
"""Which pairs reach each block of a tile, and which blocks still let light through."""

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
VISITS_ROOM = _GROUP
"""Values behind the end of a list that may be overwritten."""
_WORD, _INDEX = ir.IntType(32), ir.IntType(64)


@intrinsic
def _pack_groups(typingctx, masks, begin, groups, block, visits, at):  # type: ignore[no-untyped-def]
    """Write to ``visits[at ..]`` which of ``16 groups`` pairs reach a block; return how many.

    Sixteen pairs are one vector, of which those that count are moved to the front.
    """

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        words, bits = ir.VectorType(_WORD, _GROUP), ir.VectorType(ir.IntType(1), _GROUP)
        zeros, anything = ir.Constant(words, None), ir.Constant(words, ir.Undefined)

        def vector_at(place: int, at: Any) -> Any:
            data = context.make_array(sig.args[place])(context, builder, args[place]).data
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
            pairs = builder.add(repeated(builder.trunc(first, _WORD)), steps)
            place = builder.load(end)
            packed = builder.call(compress, [pairs, reached, anything])
            builder.store(packed, vector_at(4, place), align=4)
            number = builder.ctpop(builder.bitcast(reached, ir.IntType(_GROUP)))
            builder.store(builder.add(place, builder.zext(number, _INDEX)), end)
        return builder.sub(builder.load(end), at_)

    index = types.intp
    return types.intp(masks, index, index, index, visits, index), generate


@inline
def list_visits(
    lanes: Any, masks: Any, begin: Any, count: Any, room: Any, visits: Any, counts: Any
) -> None:
    """List the pairs ``begin .. begin + count`` of a tile by the blocks that they reach.

    Parameters
    ----------
    lanes : int
        8 or 16.
    masks : (pairs,) uint32
    room : int
        Values of ``visits`` for one block, at least ``count + VISITS_ROOM``.
    visits : (blocks * room,) int32
        Receives the numbers of the pairs of block b from ``b * room`` on, increasing.
    counts : (blocks,) int64
        Receives the length of each list.
    """
    blocks = PLANE // lanes
    if lanes == TILE:
        groups = count // _GROUP
        for block in range(blocks):
            at = block * room
            n = at + _pack_groups(masks, begin, groups, block, visits, at)  # type: ignore[call-arg]
            for k in range(begin + groups * _GROUP, begin + count):
                visits[n] = k
                n += np.int64((masks[k] >> np.uint32(block)) & np.uint32(1))
            counts[block] = n - at
    else:
        # Without instructions that pack vectors, elsewhere bit by bit.
        for block in range(blocks):
            counts[block] = 0
        for k in range(begin, begin + count):
            bits = np.uint64(masks[k])
            while bits != np.uint64(0):
                named = np.int64(lowest_bit(bits)) & (blocks - 1)
                visits[named * room + counts[named]] = k
                counts[named] += 1
                bits &= bits - np.uint64(1)


def _lit_intrinsic(lanes: int) -> Any:
    @intrinsic
    def lit(typingctx, m, plane):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            block, bits = Block(lanes, context, builder), ir.Constant(_INDEX, 0)
            state = block.data(sig.args[0], args[0])
            for number in range(PLANE // lanes):
                light = block.load(state, block.offset(args[1], number * lanes))
                passes = builder.zext((light >= float(TRANSMITTANCE_MIN)).any(), _INDEX)
                bits = builder.or_(bits, builder.shl(passes, ir.Constant(_INDEX, number)))
            return bits

        return types.uint64(m, types.intp), generate

    return lit


_lit_16, _lit_8 = _lit_intrinsic(16), _lit_intrinsic(8)


@inline
def lit_blocks(lanes: Any, m: Any, plane: Any) -> Any:
    """Return as bits the blocks with a pixel whose transmittance, at ``m[plane ..]``, counts."""
    return _lit_16(m, plane) if lanes == 16 else _lit_8(m, plane)
