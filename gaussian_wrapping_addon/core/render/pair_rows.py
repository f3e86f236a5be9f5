# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled: which rows of a tile the ellipse of each of its Gaussians reaches."""

from __future__ import annotations

import math

import numpy as np

from ..compiled import kernel
from .raster_math import TILE

# Rounding of the float32 boxes and skews that rows are computed from: pixels, share of a side.
_STRIP_MARGIN = 0.02
_SHARE_MARGIN = 1e-6


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
                        across = math.sqrt(
                            max(half_y * half_y * (1.0 + _SHARE_MARGIN) - slope * slope, 0.0)
                        )
                        t = min(max(extreme, begin), end)
                        bottom = slope * t + across * math.sqrt(max(1.0 - t * t, 0.0))
                        t = min(max(-extreme, begin), end)
                        upper = slope * t - across * math.sqrt(max(1.0 - t * t, 0.0))
                        margin = _STRIP_MARGIN + _SHARE_MARGIN * half_y
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
