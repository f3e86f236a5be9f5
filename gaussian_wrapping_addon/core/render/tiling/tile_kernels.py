# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled kernels of tile binning: pixel ranges, intersected tiles, slots, scattering."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ... import tolerances
from ...kernels.compiled import inline, kernel

_TILE = tolerances.TILE_PX
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
    begin: int,
    end: int,
    boxes: np.ndarray,
    visible: np.ndarray,
    width: int,
    height: int,
    ranges: np.ndarray,
) -> tuple[int, int]:
    """Write the pixel ranges of the Gaussians ``begin .. end``.

    Returns
    -------
    visible, spans : int
        Number of visible Gaussians, and of tile rows that they reach in total.
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
        spans += ranges[i, 1] // _TILE - ranges[i, 0] // _TILE + 1
    return count, spans


@kernel(fast=False)
def span_tiles(
    begin: int,
    end: int,
    record: int,
    span: int,
    boxes: np.ndarray,
    skews: np.ndarray,
    visible: np.ndarray,
    depths: np.ndarray,
    ranges: np.ndarray,
    spans: np.ndarray,
    records: np.ndarray,
    keys: np.ndarray,
    changes: np.ndarray,
) -> tuple[int, int, np.int64, np.int64]:
    """Find the tiles that the ellipses of the Gaussians ``begin .. end`` reach.

    The ellipse clipped to the strip of pixel centres of a tile row is convex, so the columns follow
    from its extent in x. That extent ends at the ellipse's own extreme point if the strip contains
    it, else on the nearer edge of the strip.

    Parameters
    ----------
    record, span : int
        Where writing starts in ``records`` and ``spans``.
    spans : (s, 2) uint16
        Receives first and end tile column for each tile row.
    records : (r, 5) int32
        Receives one row for each Gaussian that reaches a tile, with its number of intersections
        instead of the slot.
    keys : (r,) uint32
        Receives the bits of the distance, which order positive floats.
    changes : (tiles_y, tiles_x + 1) int32
        Receives the change in the number of intersections from each tile to the next in its row.

    Returns
    -------
    end_record, intersections, lowest_key, highest_key : int
    """
    changes[:] = 0
    all_intersections = 0
    bits = depths.view(np.uint32)
    lowest, highest = np.int64(0xFFFFFFFF), np.int64(0)
    for i in range(begin, end):
        if not visible[i]:
            continue
        first_row, last_row = ranges[i, 0] // _TILE, ranges[i, 1] // _TILE
        first, last = ranges[i, 2] // _TILE, ranges[i, 3] // _TILE
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
                upper = max(row * _TILE, ranges[i, 0]) + 0.5 - _PIXEL_MARGIN
                lower = min(row * _TILE + _TILE - 1, ranges[i, 1]) + 0.5 + _PIXEL_MARGIN
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
                        first_tile = int(first_px) // _TILE
                        end_tile = int(last_px) // _TILE + 1
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
    begin: int,
    end: int,
    first_tile: int,
    end_tile: int,
    tiles_x: int,
    spans: np.ndarray,
    records: np.ndarray,
) -> int:
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
    begin: int,
    end: int,
    begin_gaussian: int,
    end_gaussian: int,
    slot: int,
    records: np.ndarray,
    intersection_offsets: np.ndarray,
) -> None:
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
    filled: Any,
    tiles: Any,
    slots: Any,
    ids: Any,
    heads: Any,
    gaussian_ids: Any,
    intersection_slots: Any,
) -> None:
    """Scatter the buffered intersections to the heads of their tiles."""
    for intersection in range(filled):
        listed_tile = np.uint64(tiles[intersection])
        index = np.uint64(heads[listed_tile])
        heads[listed_tile] = index + np.uint64(1)
        gaussian_ids[index] = ids[intersection]
        intersection_slots[index] = slots[intersection]


@kernel(fast=False)
def scatter_tiles(
    first_tile: int,
    end_tile: int,
    first_band_tile: int,
    end_band_tile: int,
    tiles_x: int,
    ranked: np.ndarray,
    spans: np.ndarray,
    heads: np.ndarray,
    gaussian_ids: np.ndarray,
    intersection_slots: np.ndarray,
) -> None:
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
