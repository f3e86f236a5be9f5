# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled loops of the binning: pixel ranges, tiles an ellipse reaches, sorting, scattering."""

from __future__ import annotations

import math

import numpy as np

from .. import tolerances
from ..compiled import kernel

_TILE = tolerances.TILE_PX
# Rounding of the float32 box and skew, in shares of the half width and in pixels.
_SHARE_MARGIN = 1e-6
_PIXEL_MARGIN = 0.02
_RADIX_BITS = 11
_RADIX = 1 << _RADIX_BITS


@kernel(fast=False)
def _tile_columns(i: int, row: int, boxes: np.ndarray, skews: np.ndarray, ranges: np.ndarray):  # type: ignore[no-untyped-def]  # numba infers the pair of ints
    """Return first and last tile column that Gaussian i reaches in a row of tiles.

    The ellipse cut by the strip of pixel centres of the row is convex, so the columns are those
    of its extent in x. That extent ends at the ellipse's own extreme point where the strip holds
    it, else on the strip's edge nearer to it.
    """
    first, last = ranges[i, 2] // _TILE, ranges[i, 3] // _TILE
    if last == first or ranges[i, 0] // _TILE == ranges[i, 1] // _TILE or math.isinf(skews[i]):
        return first, last
    half_x = 0.5 * (np.float64(boxes[i, 2]) - np.float64(boxes[i, 0]))
    half_y = 0.5 * (np.float64(boxes[i, 3]) - np.float64(boxes[i, 1]))
    if not (half_x > 0.0 and half_y > 0.0):
        return first, last
    center_x = 0.5 * (np.float64(boxes[i, 2]) + np.float64(boxes[i, 0]))
    center_y = 0.5 * (np.float64(boxes[i, 3]) + np.float64(boxes[i, 1]))
    skew = np.float64(skews[i])
    top = (max(row * _TILE, ranges[i, 0]) + 0.5 - _PIXEL_MARGIN - center_y) / half_y
    bottom = (min(row * _TILE + _TILE - 1, ranges[i, 1]) + 0.5 + _PIXEL_MARGIN - center_y) / half_y
    top, bottom = max(top, -1.0), min(bottom, 1.0)
    if top > bottom:
        return first, last
    # At height t (in half heights) the ellipse spans skew t +- across sqrt(1 - t^2).
    across_sq = half_x * half_x * (1.0 + _SHARE_MARGIN) - skew * skew
    across = math.sqrt(across_sq) if across_sq > 0.0 else 0.0
    extreme = skew / half_x  # height of the rightmost point; the leftmost is opposite
    t = min(max(extreme, top), bottom)
    right = skew * t + across * math.sqrt(max(1.0 - t * t, 0.0))
    t = min(max(-extreme, top), bottom)
    left = skew * t - across * math.sqrt(max(1.0 - t * t, 0.0))
    margin = _PIXEL_MARGIN + _SHARE_MARGIN * half_x
    first_px = np.ceil(center_x + left - margin - 0.5)
    last_px = np.floor(center_x + right + margin - 0.5)
    # Both ends lie within the box up to the margin, so the conversion cannot overflow.
    first_px = min(max(first_px, np.float64(ranges[i, 2])), np.float64(ranges[i, 3] + 1))
    last_px = max(min(last_px, np.float64(ranges[i, 3])), np.float64(ranges[i, 2] - 1))
    if first_px > last_px:
        return first, first - 1
    return int(first_px) // _TILE, int(last_px) // _TILE


@kernel(fast=False)
def span_range(
    begin: int,
    end: int,
    boxes: np.ndarray,
    skews: np.ndarray,
    visible: np.ndarray,
    width: int,
    height: int,
    ranges: np.ndarray,
    pair_counts: np.ndarray,
) -> None:
    """Write pixel ranges and numbers of tiles of the Gaussians ``begin .. end``."""
    for i in range(begin, end):
        if not visible[i]:
            ranges[i, 0] = ranges[i, 2] = 0
            ranges[i, 1] = ranges[i, 3] = -1
            pair_counts[i] = 0
            continue
        ranges[i, 0] = int(max(np.ceil(boxes[i, 1] - 0.5), 0.0))
        ranges[i, 1] = int(min(np.floor(boxes[i, 3] - 0.5), height - 1.0))
        ranges[i, 2] = int(max(np.ceil(boxes[i, 0] - 0.5), 0.0))
        ranges[i, 3] = int(min(np.floor(boxes[i, 2] - 0.5), width - 1.0))
        pairs = 0
        for row in range(ranges[i, 0] // _TILE, ranges[i, 1] // _TILE + 1):
            first, last = _tile_columns(i, row, boxes, skews, ranges)
            pairs += last - first + 1
        pair_counts[i] = pairs


@kernel(fast=False)
def radix_order(depths: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return the indices of the visible rows by increasing distance, ties by index (int32)."""
    count = 0
    for i in range(len(depths)):
        count += visible[i]
    order = np.zeros(count, np.int32)
    keys = np.zeros(count, np.uint32)
    # Positive floats are ordered like their bit patterns.
    bits = depths.view(np.uint32)
    position = 0
    for i in range(len(depths)):
        if visible[i]:
            order[position] = i
            keys[position] = bits[i]
            position += 1
    other_order = np.zeros(count, np.int32)
    other_keys = np.zeros(count, np.uint32)
    heads = np.zeros(_RADIX, np.int64)
    for digit in range(3):
        shift = np.uint32(digit * _RADIX_BITS)
        heads[:] = 0
        for k in range(count):
            heads[(keys[k] >> shift) & np.uint32(_RADIX - 1)] += 1
        total = 0
        for value in range(_RADIX):
            number = heads[value]
            heads[value] = total
            total += number
        for k in range(count):
            value = (keys[k] >> shift) & np.uint32(_RADIX - 1)
            place = heads[value]
            heads[value] = place + 1
            other_order[place] = order[k]
            other_keys[place] = keys[k]
        order, other_order = other_order, order
        keys, other_keys = other_keys, keys
    return order


@kernel(fast=False)
def list_range(
    begin: int,
    end: int,
    order: np.ndarray,
    rank_offsets: np.ndarray,
    boxes: np.ndarray,
    skews: np.ndarray,
    ranges: np.ndarray,
    tiles_x: int,
    tiles: np.ndarray,
    counts: np.ndarray,
) -> None:
    """Write the tiles of the Gaussians ``order[begin .. end]`` and add them to ``counts``."""
    for k in range(begin, end):
        i = order[k]
        place = rank_offsets[k]
        for row in range(ranges[i, 0] // _TILE, ranges[i, 1] // _TILE + 1):
            first, last = _tile_columns(i, row, boxes, skews, ranges)
            for column in range(first, last + 1):
                tile = row * tiles_x + column
                tiles[place] = tile
                counts[tile] += 1
                place += 1


@kernel(fast=False)
def scatter_range(
    begin: int,
    end: int,
    order: np.ndarray,
    rank_offsets: np.ndarray,
    pair_offsets: np.ndarray,
    tiles: np.ndarray,
    heads: np.ndarray,
    gaussian_ids: np.ndarray,
    pair_slots: np.ndarray,
) -> None:
    """Write the pairs of the Gaussians ``order[begin .. end]`` at the tiles' ``heads``."""
    for k in range(begin, end):
        i = order[k]
        slot = pair_offsets[i]
        for listed in range(rank_offsets[k], rank_offsets[k + 1]):
            tile = tiles[listed]
            place = heads[tile]
            heads[tile] = place + 1
            gaussian_ids[place] = i
            pair_slots[place] = slot
            slot += 1
