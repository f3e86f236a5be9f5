# SPDX-License-Identifier: GPL-3.0-or-later
"""Tile intersections and block masks: kernels."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types

from ..compiled import inline, kernel
from .simd import BLOCK_COLUMNS, BLOCK_WIDTH, HALF, TILE, Block, Vector, compile_time, shuffle

# -- Compiled kernels of tile binning: pixel ranges, intersected tiles, slots, scattering ---------


# Margin for the rounding of float32 boxes and skews: relative to the half width, and in pixels.
_SHARE_MARGIN = 1e-6
_PIXEL_MARGIN = 0.02

ID = 0
"""Columns of a record: Gaussian, first and end tile row, its first span, its first slot."""
RECORD_VALUES = 5
# Intersections buffered before they are scattered; entries written for each span, however short.
_FLUSH_COUNT = 1024
_AHEAD = 4


@kernel(fast=False)
def range_pixels(
    begin: int, end: int, boxes: np.ndarray, visible: np.ndarray, width: int, height: int,
    ranges: np.ndarray,
) -> tuple[int, int]:  # fmt: skip
    """Write the pixel ranges of the Gaussians ``begin .. end``.

    Returns the number of visible Gaussians, and of tile rows that they reach in total.
    """
    count = 0
    spans = 0
    for i in range(begin, end):
        if not visible[i]:
            ranges[i, 0] = ranges[i, 2] = 0
            ranges[i, 1] = ranges[i, 3] = -1
            continue
        ranges[i, 0] = int(max(np.ceil(boxes[i, 1] - 0.5), 0.0))
        ranges[i, 1] = int(min(np.floor(boxes[i, 3] - 0.5), height - 1.0))
        ranges[i, 2] = int(max(np.ceil(boxes[i, 0] - 0.5), 0.0))
        ranges[i, 3] = int(min(np.floor(boxes[i, 2] - 0.5), width - 1.0))
        count += 1
        spans += ranges[i, 1] // TILE - ranges[i, 0] // TILE + 1
    return count, spans


@kernel(fast=False)
def span_tiles(
    begin: int, end: int, record: int, span: int, boxes: np.ndarray, skews: np.ndarray,
    visible: np.ndarray, depths: np.ndarray, ranges: np.ndarray, spans: np.ndarray,
    records: np.ndarray, keys: np.ndarray, changes: np.ndarray,
) -> tuple[int, int, np.int64, np.int64]:  # fmt: skip
    """Find the tiles that the ellipses of the Gaussians ``begin .. end`` reach.

    The ellipse clipped to the strip of pixel centres of a tile row is convex, so the columns follow
    from its extent in x. That extent ends at the ellipse's own extreme point if the strip contains
    it, else on the nearer edge of the strip.

    Writing starts at ``record`` in ``records (r, 5) int32``, a row for each Gaussian that reaches a
    tile, with its number of intersections instead of the slot, and in ``keys (r,) uint32``, the
    bits of its distance, which order positive floats; and at ``span`` in ``spans (s, 2) uint16``,
    the first and end tile column of each tile row. ``changes (tiles_y, tiles_x + 1) int32``
    receives the change in the number of intersections from each tile to the next in its row.
    Returns the end record, the number of intersections, the lowest and the highest key.
    """
    changes[:] = 0
    all_intersections = 0
    bits = depths.view(np.uint32)
    lowest, highest = np.int64(0xFFFFFFFF), np.int64(0)
    for i in range(begin, end):
        if not visible[i]:
            continue
        first_row, last_row = ranges[i, 0] // TILE, ranges[i, 1] // TILE
        first, last = ranges[i, 2] // TILE, ranges[i, 3] // TILE
        intersections = 0
        x0, x1 = np.float64(boxes[i, 0]), np.float64(boxes[i, 2])
        y0, y1 = np.float64(boxes[i, 1]), np.float64(boxes[i, 3])
        half_x, half_y = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
        whole = last == first or first_row == last_row or math.isinf(skews[i])
        if whole or not (half_x > 0.0 and half_y > 0.0):
            for row in range(first_row, last_row + 1):
                at = span + row - first_row
                spans[at, 0], spans[at, 1] = first, last + 1
                changes[row, first] += 1
                changes[row, last + 1] -= 1
            intersections = (last - first + 1) * (last_row - first_row + 1)
        else:
            center_x, center_y = 0.5 * (x1 + x0), 0.5 * (y1 + y0)
            inverse = 1.0 / half_y
            skew = np.float64(skews[i])
            # At height t (in half heights) the ellipse spans skew t +- across sqrt(1 - t^2).
            across_sq = half_x * half_x * (1.0 + _SHARE_MARGIN) - skew * skew
            across = math.sqrt(across_sq) if across_sq > 0.0 else 0.0
            extreme = skew / half_x  # height of the rightmost point; the leftmost is opposite
            margin = _PIXEL_MARGIN + _SHARE_MARGIN * half_x + 0.5
            low_px, high_px = np.float64(ranges[i, 2]), np.float64(ranges[i, 3])
            for row in range(first_row, last_row + 1):
                at = span + row - first_row
                upper = max(row * TILE, ranges[i, 0]) + 0.5 - _PIXEL_MARGIN
                lower = min(row * TILE + TILE - 1, ranges[i, 1]) + 0.5 + _PIXEL_MARGIN
                top = max((upper - center_y) * inverse, -1.0)
                bottom = min((lower - center_y) * inverse, 1.0)
                first_tile, end_tile = first, last + 1
                if top <= bottom:
                    t = min(max(extreme, top), bottom)
                    right = skew * t + across * math.sqrt(max(1.0 - t * t, 0.0))
                    t = min(max(-extreme, top), bottom)
                    left = skew * t - across * math.sqrt(max(1.0 - t * t, 0.0))
                    # Both ends lie within the box plus margin, so the conversions cannot overflow.
                    first_px = max(np.ceil(center_x + left - margin), low_px)
                    last_px = min(np.floor(center_x + right + margin - 1.0), high_px)
                    if first_px > last_px:
                        first_tile = end_tile = 0
                    else:
                        first_tile = int(first_px) // TILE
                        end_tile = int(last_px) // TILE + 1
                spans[at, 0], spans[at, 1] = first_tile, end_tile
                changes[row, first_tile] += 1
                changes[row, end_tile] -= 1
                intersections += end_tile - first_tile
        if intersections == 0:
            continue
        key = bits[i]
        lowest, highest = min(lowest, np.int64(key)), max(highest, np.int64(key))
        records[record, 0] = i
        records[record, 1] = first_row
        records[record, 2] = last_row + 1
        records[record, 3] = span
        records[record, 4] = intersections
        keys[record] = key
        record += 1
        span += last_row - first_row + 1
        all_intersections += intersections
    return record, all_intersections, lowest, highest


@kernel(fast=False)
def count_band(
    begin: int, end: int, first_tile: int, end_tile: int, tiles_x: int, spans: np.ndarray,
    records: np.ndarray,
) -> int:  # fmt: skip
    """Replace the slots by the numbers of intersections within a band; return their sum."""
    all_intersections = 0
    first_band_row, end_band_row = first_tile // tiles_x, (end_tile - 1) // tiles_x + 1
    for k in range(begin, end):
        intersections = 0
        begin_row = records[k, 1]
        offset = records[k, 3] - begin_row
        for row in range(max(begin_row, first_band_row), min(records[k, 2], end_band_row)):
            low: Any = max(row * tiles_x + np.int64(spans[offset + row, 0]), first_tile)
            high: Any = min(row * tiles_x + np.int64(spans[offset + row, 1]), end_tile)
            intersections += max(high - low, 0)
        records[k, 4] = intersections
        all_intersections += intersections
    return all_intersections


@kernel(fast=False)
def assign_slots(
    begin: int, end: int, begin_gaussian: int, end_gaussian: int, slot: int, records: np.ndarray,
    intersection_offsets: np.ndarray,
) -> None:  # fmt: skip
    """Turn the numbers of intersections into first slots, counting from ``slot``.

    Writes ``intersection_offsets`` of the Gaussians ``begin_gaussian .. end_gaussian``, whose
    records are ``begin .. end``.
    """
    i = begin_gaussian
    for k in range(begin, end):
        while i <= records[k, 0]:
            intersection_offsets[i] = slot
            i += 1
        intersections = records[k, 4]
        records[k, 4] = slot
        slot += intersections
    while i < end_gaussian:
        intersection_offsets[i] = slot
        i += 1


@kernel(fast=False)
def rank_records(
    begin: int, end: int, order: np.ndarray, records: np.ndarray, ranked: np.ndarray
) -> None:
    """Copy the records ``order[begin .. end]`` to the same indices of ``ranked``."""
    for k in range(begin, end):
        record = np.uint64(order[k])
        for column in range(RECORD_VALUES):
            ranked[k, column] = records[record, column]


@inline
def _scatter(
    filled: Any, tiles: Any, slots: Any, ids: Any, heads: Any, gaussian_ids: Any,
    intersection_slots: Any,
) -> None:  # fmt: skip
    """Scatter the buffered intersections to the heads of their tiles."""
    for intersection in range(filled):
        listed_tile = np.uint64(tiles[intersection])
        index = np.uint64(heads[listed_tile])
        heads[listed_tile] = index + np.uint64(1)
        gaussian_ids[index] = ids[intersection]
        intersection_slots[index] = slots[intersection]


@kernel(fast=False)
def scatter_tiles(
    first_tile: int, end_tile: int, first_band_tile: int, end_band_tile: int, tiles_x: int,
    ranked: np.ndarray, spans: np.ndarray, heads: np.ndarray, gaussian_ids: np.ndarray,
    intersection_slots: np.ndarray,
) -> None:  # fmt: skip
    """Write the intersections of some tiles of a band at their ``heads``.

    The tiles are ``first_tile .. end_tile``; ``ranked`` holds the records by increasing distance.
    Intersections are first collected in a buffer that stays in cache. For each span at least
    ``_AHEAD`` entries are written, those beyond its end to be overwritten by the next span: few
    spans are longer, so that their ends are not mispredicted.
    """
    room = _FLUSH_COUNT + tiles_x + _AHEAD
    tiles = np.empty(room, np.int32)
    slots = np.empty(room, np.int32)
    ids = np.empty(room, np.int32)
    filled = np.uint64(0)
    first_band_row = first_band_tile // tiles_x
    first_row, end_row = first_tile // tiles_x, (end_tile - 1) // tiles_x + 1
    for k in range(len(ranked)):
        begin_row, stop_row = ranked[k, 1], min(ranked[k, 2], end_row)
        if begin_row >= end_row or stop_row <= first_row:
            continue
        i = ranked[k, 0]
        slot = ranked[k, 4]
        offset = ranked[k, 3] - begin_row
        for row in range(max(begin_row, first_band_row), stop_row):
            span = np.uint64(offset + row)
            # The part of the span within the band has slots; that within the tiles is collected.
            low: Any = max(row * tiles_x + np.int64(spans[span, 0]), first_band_tile)
            high: Any = min(row * tiles_x + np.int64(spans[span, 1]), end_band_tile)
            width = max(high - low, 0)
            tile: Any = max(low, first_tile)
            listed = max(min(high, end_tile) - tile, 0)
            at = slot + (tile - low)
            for ahead in range(_AHEAD):
                index = filled + np.uint64(ahead)
                tiles[index] = tile + ahead
                slots[index] = at + ahead
                ids[index] = i
            for ahead in range(_AHEAD, listed):
                index = filled + np.uint64(ahead)
                tiles[index] = tile + ahead
                slots[index] = at + ahead
                ids[index] = i
            filled += np.uint64(listed)
            slot += width
            if filled >= np.uint64(_FLUSH_COUNT):
                _scatter(filled, tiles, slots, ids, heads, gaussian_ids, intersection_slots)
                filled = np.uint64(0)
    _scatter(filled, tiles, slots, ids, heads, gaussian_ids, intersection_slots)


# -- Compiled bit masks: the blocks of a tile that each of its Gaussians' ellipses reaches --------


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
    while len(rows) > _BOX:
        both = list(range(2 * rows[0].type.count))
        rows = [shuffle(builder, a, b, both) for a, b in zip(rows[::2], rows[1::2], strict=True)]
    # Four vectors of four boxes each.
    columns = []
    for column in range(_BOX):
        eight = [column + _BOX * k for k in range(2 * _BOX)]
        left = shuffle(builder, rows[0], rows[1], eight)
        right = shuffle(builder, rows[2], rows[3], eight)
        columns.append(Vector(block, shuffle(builder, left, right, range(_GROUP))))
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


@compile_time
def _mask_group(  # type: ignore[no-untyped-def]
    typingctx, lanes, ids, at, boxes, skews, left, top, masks, masks_at
):
    """Write the masks of the 16 Gaussians ``ids[at ..]`` in one tile to ``masks[masks_at ..]``."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        block = Block(_GROUP, context, builder)
        ids_data, boxes_data, skews_data, out = (
            block.data(sig.args[k], args[k]) for k in (1, 3, 4, 7)
        )
        columns = _columns(block, ids_data, args[2], boxes_data, skews_data)
        height = lanes.literal_value // BLOCK_WIDTH
        words = _reached_blocks(block, columns, args[5], args[6], height)
        pointer = builder.gep(out, [args[8]], inbounds=True)
        builder.store(words.value, builder.bitcast(pointer, words.value.type.as_pointer()), 4)
        return context.get_dummy_value()

    index, single = types.intp, types.float32
    return types.void(lanes, ids, index, boxes, skews, single, single, masks, index), generate


@functools.cache
def mask_kernel(lanes: int) -> Any:
    """Return the kernel for blocks of ``lanes`` pixels (4 wide), compiled on first call."""

    @kernel(fast=True)
    def mask_range(
        first_tile: int, end_tile: int, start: np.ndarray, gaussian_ids: np.ndarray,
        boxes: np.ndarray, skews: np.ndarray, tiles_x: int, masks: np.ndarray,
    ) -> None:  # fmt: skip
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
