# SPDX-License-Identifier: GPL-3.0-or-later
"""How many pixels a rasterizer has to evaluate, counted from the ellipses themselves.

Nothing of the renderer's own culling is used: for each pair of tile and Gaussian, the part of each
row of pixels with ``alpha >= 1/255`` is the solution of a quadratic in x.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numba
import numpy as np

from gaussian_wrapping_addon.core import tolerances
from gaussian_wrapping_addon.core.kernels.parallel import default_threads, even_bounds, run_chunks
from gaussian_wrapping_addon.core.render.raster.blend import ScreenView

_TILE = tolerances.TILE_PX
_MARGIN_PX = 0.02
"""Rounding of the float32 rows of params, as where an ellipse ends."""
_LIVENESS_EVERY = 16
_BLOCK_WIDTH = 4
_ALPHA_MIN, _ALPHA_MAX = tolerances.ALPHA_MIN, tolerances.ALPHA_MAX
_T_MIN = tolerances.TRANSMITTANCE_MIN
# Columns of the counts.
_ROWS_16, _HALVES_8, _RUNS_8, _BLOCKS_4X4, _BLOCKS_4X2, _INSIDE, _USEFUL, _OWN = range(8)


@dataclasses.dataclass(frozen=True)
class Evaluations:
    """Pixel evaluations of one forward pass by layout; rows that are opaque are not visited."""

    pairs: int
    nominal: int
    """Every pixel of every pair of tile and Gaussian."""
    rows_16: int
    """Whole rows of the tile between the first and the last that the ellipse reaches."""
    halves_8: int
    """The same rows, but of their two halves only those that the ellipse's box reaches."""
    runs_8: int
    """In each row, the halves that hold a pixel inside the ellipse."""
    blocks_4x4: int
    """Blocks of 4 x 4 pixels that hold a pixel inside."""
    blocks_4x2: int
    """Blocks 4 pixels wide and 2 high that hold a pixel inside."""
    inside: int
    """Pixels inside the ellipse: no culling can do with less."""
    useful: int
    """Pixels with ``alpha >= 1/255`` and ``T >= 1e-4``."""
    own: int
    """What the kernels evaluate, from the view's own masks."""


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _span(q: Any, limit: float, x0: float, y: float, columns: int) -> Any:
    """Return first and last of the ``columns`` pixels from ``x0`` on whose alpha is 1/255 or more.

    ``alpha >= 1/255`` is ``num <= limit den``, a quadratic in the pixel's x, with the ``limit``
    2 ln(255 opacity).
    """
    dy = y - q[1]
    a = q[2] - limit * q[7]
    b = (q[3] - limit * q[8]) * dy - 2.0 * limit * q[5]
    c = q[4] * dy * dy - limit * (1.0 + (2.0 * q[6] + q[9] * dy) * dy)
    if not a > 0.0:
        # Not an ellipse: the Gaussian lies around the camera.
        return 0, columns - 1
    # The quadratic's least value is exact to about 1e-6 of its own terms.
    root = b * b - 4.0 * a * c + 1e-6 * (b * b + abs(4.0 * a * c))
    if root < 0.0:
        return 1, 0
    middle, half = -b / (2.0 * a), math.sqrt(root) / (2.0 * a)
    left = q[0] + middle - half - _MARGIN_PX - x0 - 0.5
    right = q[0] + middle + half + _MARGIN_PX - x0 - 0.5
    if right < 0.0 or left > columns - 1.0:
        return 1, 0
    return math.ceil(max(left, 0.0)), math.floor(min(right, columns - 1.0))


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _reached_rows(
    first_tile: int,
    end_tile: int,
    params: np.ndarray,
    start: np.ndarray,
    ids: np.ndarray,
    tiles_x: int,
    width: int,
    height: int,
    rows: np.ndarray,
) -> None:
    q = np.zeros(13)
    for tile in range(first_tile, end_tile):
        top, left = tile // tiles_x * _TILE, tile % tiles_x * _TILE
        columns = min(width - left, _TILE)
        for k in range(start[tile], start[tile + 1]):
            for column in range(13):
                q[column] = params[ids[k], column]
            limit = 2.0 * math.log(q[11] * 255.0)
            rows[k, 0], rows[k, 1] = 1, 0
            found = False
            for row in range(min(height - top, _TILE)):
                first, last = _span(q, limit, float(left), top + row + 0.5, columns)
                if first <= last:
                    if not found:
                        rows[k, 0] = row
                    rows[k, 1] = row
                    found = True


def reached_rows(view: ScreenView) -> np.ndarray:
    """Return first and last row, within the tile, that holds a pixel of each pair's ellipse.

    Returns
    -------
    (pairs, 2) uint8
        (1, 0) where there is none.
    """
    lists, camera = view.lists, view.camera
    rows = np.zeros((len(lists.gaussian_ids), 2), np.uint8)

    def run(first: int, end: int) -> None:
        _reached_rows(
            first,
            end,
            view.screen.params,
            lists.start,
            lists.gaussian_ids,
            lists.tiles_x,
            camera.width,
            camera.height,
            rows,
        )

    run_chunks(run, *_chunks(view))
    return rows


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _bits(value: int) -> int:
    count = 0
    while value:
        value &= value - 1
        count += 1
    return count


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _live_blocks(
    through: np.ndarray, rows: int, columns: int, block_width: int, block_height: int
) -> int:
    """Return as bits which blocks, numbered row by row, hold a pixel that is not opaque."""
    live = 0
    for row in range(rows):
        for column in range(columns):
            if through[row, column] >= _T_MIN:
                block = row // block_height * (_TILE // block_width) + column // block_width
                live |= 1 << block
    return live


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _count(
    first_tile: int,
    end_tile: int,
    params: np.ndarray,
    start: np.ndarray,
    ids: np.ndarray,
    ranges: np.ndarray,
    rows: np.ndarray,
    masks: np.ndarray,
    block_width: int,
    block_height: int,
    tiles_x: int,
    width: int,
    height: int,
    totals: np.ndarray,
) -> None:
    q = np.zeros(13)
    through = np.zeros((_TILE, _TILE))
    for tile in range(first_tile, end_tile):
        top, left = tile // tiles_x * _TILE, tile % tiles_x * _TILE
        columns, live_rows = min(width - left, _TILE), min(height - top, _TILE)
        through[:] = 1.0
        live = (1 << live_rows) - 1
        live_blocks = _live_blocks(through, live_rows, columns, block_width, block_height)
        for k in range(start[tile], start[tile + 1]):
            if live == 0:
                break
            i = ids[k]
            totals[_OWN] += block_width * block_height * _bits(np.int64(masks[k]) & live_blocks)
            for column in range(13):
                q[column] = params[i, column]
            limit = 2.0 * math.log(q[11] * 255.0)
            first_half = max(ranges[i, 2] - left, 0) // 8
            last_half = min(ranges[i, 3] - left, _TILE - 1) // 8
            blocks, flat_blocks = 0, 0
            for row in range(np.int64(rows[k, 0]), np.int64(rows[k, 1]) + 1):
                if not live >> row & 1:
                    continue
                totals[_ROWS_16] += 16
                totals[_HALVES_8] += 8 * (last_half - first_half + 1)
                y = top + row + 0.5
                first, last = _span(q, limit, float(left), y, columns)
                if first > last:
                    continue
                totals[_RUNS_8] += 8 * (last // 8 - first // 8 + 1)
                for block in range(first // 4, last // 4 + 1):
                    blocks |= 1 << (row // 4 * 4 + block)
                    flat_blocks |= 1 << (row // 2 * 4 + block)
                totals[_INSIDE] += last - first + 1
                dy = y - q[1]
                for column in range(first, last + 1):
                    before = through[row, column]
                    if before < _T_MIN:
                        continue
                    dx = left + column + 0.5 - q[0]
                    num = q[2] * dx * dx + q[3] * dx * dy + q[4] * dy * dy
                    den = 1.0 + 2.0 * (q[5] * dx + q[6] * dy)
                    den += q[7] * dx * dx + q[8] * dx * dy + q[9] * dy * dy
                    alpha = min(q[11] * math.exp(-0.5 * max(num, 0.0) / den), _ALPHA_MAX)
                    if alpha >= _ALPHA_MIN:
                        through[row, column] = before - alpha * before
                        totals[_USEFUL] += 1
            totals[_BLOCKS_4X4] += 16 * _bits(blocks)
            totals[_BLOCKS_4X2] += 8 * _bits(flat_blocks)
            if (k - start[tile]) % _LIVENESS_EVERY == _LIVENESS_EVERY - 1:
                for row in range(live_rows):
                    if through[row, :columns].max() < _T_MIN:
                        live &= ~(1 << row)
                live_blocks = _live_blocks(through, live_rows, columns, block_width, block_height)


def own_masks(view: ScreenView) -> tuple[np.ndarray, int]:
    """Return which blocks of its tile the kernels visit for each pair, and the blocks' width.

    Returns
    -------
    masks : (pairs,) uint32
        One bit per block of the lanes' number of pixels, numbered row by row.
    block_width : int
    """
    return view.masks, _BLOCK_WIDTH


def count_evaluations(view: ScreenView, lanes: int, rows: np.ndarray | None = None) -> Evaluations:
    """Count what one forward pass of a view evaluates.

    Parameters
    ----------
    view : ScreenView
        Prepared for runs of ``lanes`` pixels.
    lanes : int
        8 or 16.
    rows : (pairs, 2) uint8, optional
        From :func:`reached_rows`, if it was called already.
    """
    rows = reached_rows(view) if rows is None else rows
    masks, block_width = own_masks(view)
    lists, camera = view.lists, view.camera
    results: list[np.ndarray] = []

    def run(first: int, end: int) -> None:
        totals = np.zeros(8, np.int64)
        _count(
            first,
            end,
            view.screen.params,
            lists.start,
            lists.gaussian_ids,
            lists.pixel_ranges,
            rows,
            masks,
            block_width,
            lanes // block_width,
            lists.tiles_x,
            camera.width,
            camera.height,
            totals,
        )
        results.append(totals)

    run_chunks(run, *_chunks(view))
    pairs = len(lists.gaussian_ids)
    totals = [int(value) for value in np.sum(results, axis=0)]
    return Evaluations(pairs, pairs * _TILE * _TILE, *totals)


def _chunks(view: ScreenView) -> tuple[np.ndarray, int]:
    """Return runs of tiles for all cores: counting is not timed."""
    threads = default_threads()
    return even_bounds(len(view.lists.start) - 1, threads, 16), threads
