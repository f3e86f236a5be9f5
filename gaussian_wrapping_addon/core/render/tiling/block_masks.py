# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled bit masks: the blocks of a tile that each of its Gaussians' ellipses reaches."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from ...kernels.compiled import inline, kernel
from ..simd.raster_math import BLOCK_COLUMNS, BLOCK_WIDTH, HALF, TILE
from ..simd.simd import Block, Vector

# Margins for the rounding of float32 boxes and skews and of the float32 arithmetic here, outwards:
# in pixels, relative to the ellipse's size and position, and for the squared half chord near the
# ellipse's ends.
_MARGIN_PX = 0.02
_MARGIN_SHARE = 4e-6
_MARGIN_CHORD = 4e-6
_BOUNDED = 1.1
"""Largest ratio of skew to half width of a bounded ellipse, with a margin for rounding."""
_GROUP = TILE
"""Intersections per vector."""
_BOX = 4
_WORD, _INDEX = ir.IntType(32), ir.IntType(64)
_FULL_ROW = (1 << BLOCK_COLUMNS) - 1


class _Words:
    """A vector of unsigned 32-bit integers, one per intersection."""

    def __init__(self, block: Block, value: Any) -> None:
        self.block, self.value = block, value

    @classmethod
    def of(cls, block: Block, number: int) -> _Words:
        """Broadcast a number."""
        words = ir.VectorType(_WORD, block.lanes)
        return cls(block, ir.Constant(words, [ir.Constant(_WORD, number)] * block.lanes))

    @classmethod
    def truncated(cls, value: Vector) -> _Words:
        """Truncate floating-point numbers >= 0."""
        block = value.block
        kind = ir.VectorType(_WORD, block.lanes)
        return cls(block, block.builder.fptosi(value.value, kind))

    def __lshift__(self, other: _Words) -> _Words:
        return _Words(self.block, self.block.builder.shl(self.value, other.value))

    def __rshift__(self, other: _Words) -> _Words:
        return _Words(self.block, self.block.builder.lshr(self.value, other.value))

    def __and__(self, other: _Words) -> _Words:
        return _Words(self.block, self.block.builder.and_(self.value, other.value))

    def __or__(self, other: _Words) -> _Words:
        return _Words(self.block, self.block.builder.or_(self.value, other.value))


def _columns(block: Block, ids: Any, at: Any, boxes: Any, skews: Any) -> list[Vector]:
    """Return the four box columns and the skews of 16 Gaussians."""
    builder, quad = block.builder, Block(_BOX, block.context, block.builder)
    rows, skew = [], ir.Constant(block.kind, ir.Undefined)
    for number in range(_GROUP):
        pointer = builder.gep(ids, [block.offset(at, number)], inbounds=True)
        gaussian = builder.sext(builder.load(pointer), _INDEX)
        rows.append(quad.load(boxes, builder.mul(gaussian, block.index(_BOX))).value)
        number_ = ir.Constant(_WORD, number)
        skew = builder.insert_element(skew, block.scalar(skews, gaussian), number_)

    def shuffle(a: Any, b: Any, order: list[int]) -> Any:
        indices = [ir.Constant(_WORD, k) for k in order]
        kind = ir.VectorType(_WORD, len(order))
        return builder.shuffle_vector(a, b, ir.Constant(kind, indices))

    while len(rows) > _BOX:
        both = list(range(2 * rows[0].type.count))
        rows = [shuffle(a, b, both) for a, b in zip(rows[::2], rows[1::2], strict=True)]
    # Four vectors of four boxes each.
    columns = []
    for column in range(_BOX):
        eight = [column + _BOX * k for k in range(2 * _BOX)]
        left, right = shuffle(rows[0], rows[1], eight), shuffle(rows[2], rows[3], eight)
        columns.append(Vector(block, shuffle(left, right, list(range(_GROUP)))))
    return [*columns, Vector(block, skew)]


def _reached_blocks(
    block: Block, columns: list[Vector], left: Any, top: Any, height: int
) -> _Words:
    """Return the masks of 16 intersections for blocks ``height`` rows high."""
    x0, y0, x1, y1, skew = columns
    tile_x, tile_y = block.splat(left), block.splat(top)
    half_x, half_y = (x1 - x0) * 0.5, (y1 - y0) * 0.5
    center_x = ((x0 - tile_x) + (x1 - tile_x)) * 0.5
    center_y = ((y0 - tile_y) + (y1 - tile_y)) * 0.5
    # The box of an unbounded ellipse is the image and its skew infinite; fast-math comparisons
    # with infinity would be folded away, one with a number is not.
    bounded = (half_x > 0.0) & (half_y > 0.0) & (skew.abs() <= half_x * _BOUNDED)
    inverse_y = 1.0 / half_y
    # At height t (in half heights) the ellipse spans skew t +- across sqrt(1 - t^2); its rightmost
    # point is at height skew / half_x, the leftmost opposite.
    extreme = (skew / half_x).max(-1.0).min(1.0)
    across = (half_x * half_x - skew * skew).max(0.0).sqrt() + half_x * _MARGIN_SHARE
    margin = (center_x.abs() + half_x) * _MARGIN_SHARE + _MARGIN_PX
    edge = (center_y.abs() + half_y) * _MARGIN_SHARE + _MARGIN_PX
    # From here on in units of the block width.
    across, skew = across * (1.0 / BLOCK_WIDTH), skew * (1.0 / BLOCK_WIDTH)
    last = (center_x + margin) * (1.0 / BLOCK_WIDTH) + 1.0
    first = (margin - center_x) * (1.0 / BLOCK_WIDTH) + (
        BLOCK_COLUMNS + (BLOCK_WIDTH - 1) / BLOCK_WIDTH
    )
    above, below = (center_y + edge) * inverse_y * -1.0, (edge - center_y) * inverse_y
    masks = _Words.of(block, 0)
    for strip in range(TILE // height):
        upper = inverse_y * float(strip * height) + above
        lower = inverse_y * float((strip + 1) * height - 1) + below
        meets = (upper <= 1.0) & (lower >= -1.0)
        upper, lower = upper.max(-1.0).min(1.0), lower.max(-1.0).min(1.0)
        # Right and left extent of the part of the ellipse inside the strip.
        reach = []
        for turned in (extreme, -extreme):
            t = turned.max(upper).min(lower)
            reach.append((skew * t, across * ((1.0 - t * t).max(0.0) + _MARGIN_CHORD).sqrt()))
        right, left_ = reach[0][0] + reach[0][1], reach[1][1] - reach[1][0]
        # Number of block columns that start left of its right end, and that end right of its left.
        before = meets.select((right + last).max(0.0).min(float(BLOCK_COLUMNS)), 0.0)
        behind = (left_ + first).max(0.0).min(float(BLOCK_COLUMNS))
        full = _Words.of(block, _FULL_ROW)
        far = _Words.of(block, _FULL_ROW << (2 * BLOCK_COLUMNS))
        # Both as bit masks of one row, shifted by the number of columns.
        row = (full << _Words.truncated(before)) & (far >> _Words.truncated(behind))
        by = (strip - 1) * BLOCK_COLUMNS
        shift = _Words.of(block, abs(by))
        masks = masks | (row << shift if by >= 0 else row >> shift)
    all_blocks = _Words.of(block, (1 << BLOCK_COLUMNS * (TILE // height)) - 1)
    chosen = block.builder.select(bounded.value, masks.value, all_blocks.value)
    return _Words(block, chosen)


def _mask_intrinsic(lanes: int) -> Any:
    @intrinsic
    def mask(  # type: ignore[no-untyped-def]
        typingctx, ids, at, boxes, skews, left, top, masks, masks_at
    ):
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            block = Block(_GROUP, context, builder)
            ids_data, boxes_data, skews_data, out = (
                block.data(sig.args[k], args[k]) for k in (0, 2, 3, 6)
            )
            columns = _columns(block, ids_data, args[1], boxes_data, skews_data)
            words = _reached_blocks(block, columns, args[4], args[5], lanes // BLOCK_WIDTH)
            pointer = builder.gep(out, [args[7]], inbounds=True)
            builder.store(words.value, builder.bitcast(pointer, words.value.type.as_pointer()), 4)
            return context.get_dummy_value()

        index, single = types.intp, types.float32
        return types.void(ids, index, boxes, skews, single, single, masks, index), generate

    return mask


_mask_16, _mask_8 = _mask_intrinsic(16), _mask_intrinsic(8)


@inline
def _mask_group(
    lanes: Any, ids: Any, at: Any, boxes: Any, skews: Any, left: Any, top: Any, out: Any,
    out_at: Any,
) -> None:  # fmt: skip
    """Write the masks of the 16 Gaussians ``ids[at ..]`` in one tile to ``out[out_at ..]``."""
    if lanes == 16:
        _mask_16(ids, at, boxes, skews, left, top, out, out_at)
    else:
        _mask_8(ids, at, boxes, skews, left, top, out, out_at)


@functools.cache
def mask_kernel(lanes: int) -> Any:
    """Return the kernel for blocks of ``lanes`` pixels (4 wide), compiled on first call."""

    @kernel(fast=True)
    def mask_range(
        first_tile: int,
        end_tile: int,
        start: np.ndarray,
        gaussian_ids: np.ndarray,
        boxes: np.ndarray,
        skews: np.ndarray,
        tiles_x: int,
        masks: np.ndarray,
    ) -> None:
        """Write ``masks (intersections,) uint32``: bit ``4 block row + block column`` of the tile.

        The part of the ellipse between the first and last pixel centres of a row of blocks is
        convex, so its extent in x determines the blocks it meets. Sixteen intersections are one
        vector.
        """
        few = np.zeros(_GROUP, np.int32)
        found = np.zeros(_GROUP, np.uint32)
        for tile in range(first_tile, end_tile):
            top = np.float32(tile // tiles_x * TILE) + HALF
            left = np.float32(tile % tiles_x * TILE) + HALF
            k = np.int64(start[tile])
            end = np.int64(start[tile + 1])
            while k + _GROUP <= end:
                _mask_group(lanes, gaussian_ids, k, boxes, skews, left, top, masks, k)
                k += _GROUP
            if k < end:
                for n in range(_GROUP):
                    few[n] = gaussian_ids[min(k + n, end - 1)]
                _mask_group(lanes, few, 0, boxes, skews, left, top, found, 0)
                for n in range(end - k):
                    masks[k + n] = found[n]

    return mask_range
