# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled: which blocks of a tile the ellipse of each of its Gaussians reaches."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from ..compiled import kernel
from .raster_math import BLOCK_COLUMNS, BLOCK_WIDTH, ONE, TILE, ZERO

# Rounding of float32 boxes and skews and of this file's float32 arithmetic, all outwards: pixels,
# share of the ellipse's size and place, and of the squared half chord near the ellipse's ends.
_MARGIN_PX = np.float32(0.02)
_MARGIN_SHARE = np.float32(4e-6)
_MARGIN_CHORD = np.float32(4e-6)
_STRIP_ROWS = 2
_STRIPS = TILE // _STRIP_ROWS
_RISE = np.float32(_STRIP_ROWS - 1)
_REACH = np.float32(BLOCK_WIDTH - 1)


@functools.cache
def mask_kernel(lanes: int) -> Any:
    """Return the kernel for blocks of ``lanes`` pixels (4 wide), compiled on first call."""
    merged = lanes == TILE
    all_blocks = np.uint32(0xFFFF if merged else 0xFFFFFFFF)

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
        """Write ``masks (pairs,) uint32``: bit ``4 row of blocks + column`` per block of the tile.

        The part of the ellipse between the pixel centres of a strip of two rows is convex, so its
        extent in x says which columns of blocks it meets there. Eight strips are one vector; the
        masks of blocks four rows high join two strips.
        """
        for tile in range(first_tile, end_tile):
            top = np.float64(tile // tiles_x * TILE) + 0.5
            left = np.float64(tile % tiles_x * TILE) + 0.5
            for k in range(start[tile], start[tile + 1]):
                i = np.int64(gaussian_ids[k])
                skew = np.float32(skews[i])
                x0, y0 = np.float64(boxes[i, 0]), np.float64(boxes[i, 1])
                x1, y1 = np.float64(boxes[i, 2]), np.float64(boxes[i, 3])
                half_x, half_y = np.float32(0.5 * (x1 - x0)), np.float32(0.5 * (y1 - y0))
                # The box of an unbounded ellipse is the image and its skew infinite; fast-math
                # comparisons with infinity would be folded away, one with a number is not.
                if not (half_x > ZERO and half_y > ZERO and abs(skew) <= half_x * np.float32(1.1)):
                    masks[k] = all_blocks
                    continue
                center_x = np.float32(0.5 * (x1 + x0) - left)
                center_y = np.float32(0.5 * (y1 + y0) - top)
                inverse_y = ONE / half_y
                # At height t (in half heights) the ellipse spans skew t +- across sqrt(1 - t^2);
                # its rightmost point is at height skew / half_x, the leftmost opposite.
                extreme = min(max(skew / half_x, -ONE), ONE)
                chord = math.sqrt(max(half_x * half_x - skew * skew, ZERO))
                across = np.float32(chord) + _MARGIN_SHARE * half_x
                margin = _MARGIN_PX + _MARGIN_SHARE * (abs(center_x) + half_x)
                edge = _MARGIN_PX + _MARGIN_SHARE * (abs(center_y) + half_y)
                mask = np.uint32(0)
                for strip in range(_STRIPS):
                    row = np.float32(strip * _STRIP_ROWS) - center_y
                    upper = (row - edge) * inverse_y
                    lower = (row + _RISE + edge) * inverse_y
                    meets = (upper <= ONE) & (lower >= -ONE)
                    upper = min(max(upper, -ONE), ONE)
                    lower = min(max(lower, -ONE), ONE)
                    t = min(max(extreme, upper), lower)
                    right = skew * t + across * math.sqrt(max(ONE - t * t, ZERO) + _MARGIN_CHORD)
                    t = min(max(-extreme, upper), lower)
                    begin = skew * t - across * math.sqrt(max(ONE - t * t, ZERO) + _MARGIN_CHORD)
                    begin = center_x + begin - margin
                    right = center_x + right + margin
                    bits = np.uint32(0)
                    for column in range(BLOCK_COLUMNS):
                        low = np.float32(column * BLOCK_WIDTH)
                        hit = meets & (begin <= low + _REACH) & (right >= low)
                        bits |= np.uint32(1 << column) if hit else np.uint32(0)
                    mask |= bits << np.uint32(strip * BLOCK_COLUMNS)
                if merged:
                    mask = (mask | (mask >> np.uint32(4))) & np.uint32(0x0F0F0F0F)
                    mask = (mask | (mask >> np.uint32(4))) & np.uint32(0x00FF00FF)
                    mask = (mask | (mask >> np.uint32(8))) & np.uint32(0xFFFF)
                masks[k] = mask

    return mask_range
