# SPDX-License-Identifier: GPL-3.0-or-later
"""The Gaussians that reach a cell of a tile, in a layout for vectorised loops.

Vectors run over the Gaussians of a cell, not over positions, so that a single position costs no
more than one of many. The Gaussians of a cell are stored in *spans* of 32, column by column with 32
values each, in one array at constant offsets, which is what lets LLVM vectorise.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...kernels.compiled import inline, part
from ..simd.raster_math import FAR, FRONT_SIGMAS, ONE, PREFETCH_AHEAD, ZERO
from ..simd.vector_runs import lowest_bit, positive_run, prefetch_row
from ..tiling.area_lists import PIXEL_MARGIN, SHARE_MARGIN, TILE

GEOMETRY = 13
"""Leading columns of params that a ray's transmittance depends on."""

SPAN = 32
RUN = 16
"""Values of a span tested at once."""
# Columns of a span: the Gaussians; kernels append columns of their own.
U, V, QA, QB, QC = 0, SPAN, 2 * SPAN, 3 * SPAN, 4 * SPAN
PX, PY, R, S, T = 5 * SPAN, 6 * SPAN, 7 * SPAN, 8 * SPAN, 9 * SPAN
Z, OPACITY, A0 = 10 * SPAN, 11 * SPAN, 12 * SPAN
# Columns of a tile's span: the Gaussians, the nearest depth they reach, and their ellipses.
_NEAREST, _CENTER_X, _CENTER_Y, _SKEW = 13 * SPAN, 14 * SPAN, 15 * SPAN, 16 * SPAN
_EXTREME, _INVERSE, _ACROSS, _MARGIN = 17 * SPAN, 18 * SPAN, 19 * SPAN, 20 * SPAN
_INTERSECTS = 21 * SPAN
TILE_COLUMNS = 22
_FLOAT_MARGIN = np.float32(4e-6)
"""A few float32 rounding errors, relative."""


@part(fast=False)
def fill_tile(
    tile: int,
    tiles_x: int,
    params: np.ndarray,
    boxes: np.ndarray,
    skews: np.ndarray,
    start: np.ndarray,
    gaussian_ids: np.ndarray,
    spans: np.ndarray,
) -> None:
    """Store the Gaussians of a tile and their ellipses in ``spans (s, 22 * 32) float32``."""
    left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
    count = start[tile + 1] - start[tile]
    for k in range(count):
        ahead = start[tile] + min(k + PREFETCH_AHEAD, count - 1)
        prefetch_row(params, np.int64(gaussian_ids[ahead]))
        i = gaussian_ids[start[tile] + k]
        span = spans[k // SPAN]
        lane = k % SPAN
        for column in range(GEOMETRY):
            span[column * SPAN + lane] = params[i, column]
        span[_NEAREST + lane] = params[i, 10] - FRONT_SIGMAS * params[i, 22]
        half_x = 0.5 * (np.float64(boxes[i, 2]) - np.float64(boxes[i, 0]))
        half_y = 0.5 * (np.float64(boxes[i, 3]) - np.float64(boxes[i, 1]))
        skew = np.float64(skews[i])
        if math.isinf(skew) or not (half_x > 0.0 and half_y > 0.0):
            # No ellipse that could exclude a cell.
            span[_CENTER_X + lane] = span[_CENTER_Y + lane] = span[_SKEW + lane] = ZERO
            span[_EXTREME + lane] = span[_INVERSE + lane] = span[_MARGIN + lane] = ZERO
            span[_ACROSS + lane] = FAR
            continue
        center_x: Any = 0.5 * (np.float64(boxes[i, 2]) + np.float64(boxes[i, 0])) - left
        across: Any = max(half_x * half_x * (1.0 + SHARE_MARGIN) - skew * skew, 0.0)
        span[_CENTER_X + lane] = center_x
        span[_CENTER_Y + lane] = 0.5 * (np.float64(boxes[i, 3]) + np.float64(boxes[i, 1])) - top
        span[_SKEW + lane] = skew
        span[_EXTREME + lane] = skew / half_x
        span[_INVERSE + lane] = 1.0 / half_y
        span[_ACROSS + lane] = math.sqrt(across)
        span[_MARGIN + lane] = PIXEL_MARGIN + _FLOAT_MARGIN * (half_x + abs(center_x))
    for k in range(count, (count + SPAN - 1) // SPAN * SPAN):
        span = spans[k // SPAN]
        for column in range(TILE_COLUMNS):
            span[column * SPAN + k % SPAN] = ZERO
        span[_NEAREST + k % SPAN] = FAR
        span[_CENTER_X + k % SPAN] = -FAR


@inline
def _mark_intersecting(span: Any, x0: Any, y0: Any, x1: Any, y1: Any) -> None:
    """Mark with 1 the ellipses of a span that reach a rectangle, see ``area_lists.strip_span``."""
    for j in range(SPAN):
        inverse, center_y = span[_INVERSE + j], span[_CENTER_Y + j]
        first = max((y0 - center_y) * inverse - _FLOAT_MARGIN, -ONE)
        last = min((y1 - center_y) * inverse + _FLOAT_MARGIN, ONE)
        extreme, skew, across = span[_EXTREME + j], span[_SKEW + j], span[_ACROSS + j]
        t = min(max(extreme, first), last)
        right = skew * t + across * math.sqrt(max(ONE - t * t, ZERO))
        t = min(max(-extreme, first), last)
        left = skew * t - across * math.sqrt(max(ONE - t * t, ZERO))
        center_x, margin = span[_CENTER_X + j], span[_MARGIN + j]
        intersects = (first <= last) & (center_x + right + margin >= x0)
        intersects = intersects & (center_x + left - margin <= x1)
        span[_INTERSECTS + j] = ONE if intersects else ZERO


@part(fast=True)
def fill_cell(
    columns: int,
    part: int,
    shift: int,
    count: int,
    tile_spans: np.ndarray,
    spans: np.ndarray,
    nearest_depths: np.ndarray,
    members: np.ndarray,
) -> int:
    """Store the Gaussians of a tile that reach one of its cells; return their number.

    Parameters
    ----------
    columns : int
        Columns of ``spans``.
    part : int
        Index of the cell within its tile.
    count : int
        Gaussians of the tile.
    tile_spans : (t, 22 * 32) float32
        From :func:`fill_tile`.
    spans : (s, columns * 32) float32
        The last span is padded with Gaussians of opacity 0.
    nearest_depths : (s + 1,) float32
        Receives the z-depth in front of which every Gaussian of this span and later ones has
        negligible density.
    members : (g,) int64
        Receives the index of each Gaussian in the tile's list.
    """
    cell_px = TILE >> shift
    margin = np.float32(PIXEL_MARGIN)
    x0 = np.float32((part & ((1 << shift) - 1)) * cell_px)
    y0 = np.float32((part >> shift) * cell_px)
    x1, y1 = x0 + np.float32(cell_px), y0 + np.float32(cell_px)
    total: Any = 0
    for at in range((count + SPAN - 1) // SPAN):
        source = tile_spans[at]
        if shift > 0:
            _mark_intersecting(source, x0, y0 - margin, x1, y1 + margin)
        else:
            for lane in range(SPAN):
                source[_INTERSECTS + lane] = ONE if at * SPAN + lane < count else ZERO
        for run in range(0, SPAN, RUN):
            hits = positive_run(RUN, source, _INTERSECTS + run)
            while hits != np.uint64(0):
                j = run + np.int64(lowest_bit(hits))
                hits &= hits - np.uint64(1)
                target = spans[total // SPAN]
                lane = total % SPAN
                for column in range(GEOMETRY):
                    target[column * SPAN + lane] = source[column * SPAN + j]
                nearest, to = source[_NEAREST + j], total // SPAN
                nearest_depths[to] = nearest if lane == 0 else min(nearest_depths[to], nearest)
                members[total] = at * SPAN + j
                total += 1
    last = (total + SPAN - 1) // SPAN
    for k in range(total, last * SPAN):
        for column in range(columns):
            spans[last - 1, column * SPAN + k % SPAN] = ZERO
    nearest_depths[last] = FAR
    for at in range(last - 1, -1, -1):
        nearest_depths[at] = min(nearest_depths[at], nearest_depths[at + 1])
    return total


@part(fast=False)
def longest_list(
    first_tile: int, end_tile: int, start: np.ndarray, shift: int, cell_start: np.ndarray
) -> int:
    """Return the length of the longest list of the tiles that contain positions."""
    longest = 0
    for tile in range(first_tile, end_tile):
        if cell_start[tile << (2 * shift)] < cell_start[(tile + 1) << (2 * shift)]:
            longest = max(longest, start[tile + 1] - start[tile])
    return longest
