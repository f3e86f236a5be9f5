# SPDX-License-Identifier: GPL-3.0-or-later
"""Vacancy of points: kernels."""

from __future__ import annotations

import numpy as np

from ..compiled import inline, kernel

# -- Compiled kernels of the vacancy field: binning of Gaussians and points, transmittance --------


# mypy: disable-error-code="no-untyped-def"


ROW_COLUMNS = 16
"""Columns of a projected Gaussian, one cache line of float32: u v qa qb qc px py r s t z a0
opacity, the largest footprint distance, the depth from which it contributes, and 0."""

BOUND_COLUMNS = 8
"""Columns of a footprint's bounds, float32 pixels: x0 y0 x1 y1, unit normal of its narrowest strip,
the strip's centre along the normal, and its half width."""

GROUP = 64
LANES = 16
CHECK_EVERY = 16
"""Gaussians between two checks of whether any point of a group can still improve."""

# float32 constants: a plain Python float would widen the loops to float64.
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_TWO = np.float32(2.0)
_FAR = np.float32(1e30)
_HALF = np.float32(0.5)
_FACTOR_MIN = np.float32(1e-7)
_T_MIN = np.float32(1e-4)
# exp(-x) = (1 + y p(y))^16 with y = x / 16 in [0, 0.75]: relative error below 4e-6.
_EXP_MAX = np.float32(12.0)
_SIXTEENTH = np.float32(1.0 / 16.0)
_C0 = np.float32(-0.9999999869276294)
_C1 = np.float32(0.4999987433680523)
_C2 = np.float32(-0.16664698331268157)
_C3 = np.float32(0.04155307679491795)
_C4 = np.float32(-0.008033159328771324)
_C5 = np.float32(0.0010119646615415825)


@inline
def _exp_minus(x):
    """Return exp(-x) for x >= 0, with x clamped to 12."""
    y = min(x, _EXP_MAX) * _SIXTEENTH
    e = _ONE + y * (_C0 + y * (_C1 + y * (_C2 + y * (_C3 + y * (_C4 + y * _C5)))))
    e = e * e
    e = e * e
    e = e * e
    return e * e


@inline
def _strip_misses(bounds, i, x, y, half_x, half_y):
    """Tell whether a rectangle around (x, y) with given half sides lies outside the strip."""
    nx, ny = bounds[i, 4], bounds[i, 5]
    outside = abs(nx * x + ny * y - bounds[i, 6]) - bounds[i, 7]
    return outside > half_x * abs(nx) + half_y * abs(ny)


@kernel(fast=False)
def list_tiles(bounds, tile_px, tiles_x, tiles_y, heads, ids, write):
    """Count the footprints of each tile in ``heads``, or write them, in order, to its list.

    When writing, ``heads`` holds the begin of each list and is advanced.
    """
    half = _HALF * tile_px
    for i in range(bounds.shape[0]):
        x0 = min(max(int(bounds[i, 0] / tile_px), 0), tiles_x - 1)
        x1 = min(max(int(bounds[i, 2] / tile_px), 0), tiles_x - 1)
        y0 = min(max(int(bounds[i, 1] / tile_px), 0), tiles_y - 1)
        y1 = min(max(int(bounds[i, 3] / tile_px), 0), tiles_y - 1)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                middle_x = np.float32(x) * tile_px + half
                middle_y = np.float32(y) * tile_px + half
                if _strip_misses(bounds, i, middle_x, middle_y, half, half):
                    continue
                t = y * tiles_x + x
                if write:
                    ids[heads[t]] = i
                heads[t] += 1


@kernel(fast=False)
def project_points(
    begin, end, points, camera, settled, best, tile_px, shift, tiles_x, tiles_y, screen, cells
):
    """Project points; write pixel and z-depth, and the cell, or -1 for skipped points.

    ``camera`` is packed as in ``render.projection.pack_camera``. A point is skipped if its ``best``
    is above ``settled``, if it is not deeper than the near plane, or outside the image. Cells
    divide each side of a tile by 2^shift and are numbered tile by tile.
    """
    mask = (1 << shift) - 1
    cell_px = tile_px / (mask + 1)
    for p in range(begin, end):
        cells[p] = -1
        if best[p] > settled:
            continue
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        w = camera[6] * x + camera[7] * y + camera[8] * z + camera[11]
        if not w > camera[21]:
            continue
        u = camera[15] * (camera[0] * x + camera[1] * y + camera[2] * z + camera[9]) / w
        v = camera[16] * (camera[3] * x + camera[4] * y + camera[5] * z + camera[10]) / w
        u += camera[17]
        v += camera[18]
        # Written so that a NaN fails the test.
        if not (u >= 0.0 and v >= 0.0 and u <= camera[19] and v <= camera[20]):
            continue
        screen[p, 0] = u
        screen[p, 1] = v
        screen[p, 2] = w
        cx = min(int(u / cell_px), (tiles_x << shift) - 1)
        cy = min(int(v / cell_px), (tiles_y << shift) - 1)
        tile = (cy >> shift) * tiles_x + (cx >> shift)
        cells[p] = (tile << (2 * shift)) + ((cy & mask) << shift) + (cx & mask)


@kernel(fast=False)
def sort_by_cell(cells, start, order):
    """Sort points by cell with a stable counting sort; return the number of points with a cell.

    ``start (cells + 2,)`` must be zero; afterwards cell c holds ``order[start[c] : start[c + 1]]``.
    """
    for p in range(cells.shape[0]):
        if cells[p] >= 0:
            start[cells[p] + 2] += 1
    for c in range(2, start.shape[0]):
        start[c] += start[c - 1]
    for p in range(cells.shape[0]):
        if cells[p] >= 0:
            order[start[cells[p] + 1]] = p
            start[cells[p] + 1] += 1
    return start[start.shape[0] - 1]


@kernel(fast=True)
def transmittance_of_cells(
    begin, end, cell_start, order, screen, rows, bounds, tile_start, tile_ids, list_capacity, shift,
    camera_index, best, winner,
):  # fmt: skip
    """Update ``best`` and ``winner`` of the points of cells ``begin .. end`` by one camera.

    Transmittance below 1e-4 counts as 0. Ties go to the lower camera index.
    """
    near = np.empty(list_capacity, np.int32)
    # Rows of GROUP: x, y, depth, transmittance, value to exceed. One array with constant offsets
    # lets the compiler prove that they do not overlap.
    M = np.empty(5 * GROUP, np.float32)
    for cell in range(begin, end):
        first, last = cell_start[cell], cell_start[cell + 1]
        if last <= first:
            continue
        tile = cell >> (2 * shift)
        # Bounds of the points themselves, often much smaller than the cell.
        x0, y0 = _FAR, _FAR
        x1, y1, deepest = -_ONE, -_ONE, _ZERO
        for p in range(first, last):
            u, v = screen[order[p], 0], screen[order[p], 1]
            x0, x1 = min(x0, u), max(x1, u)
            y0, y1 = min(y0, v), max(y1, v)
            deepest = max(deepest, screen[order[p], 2])
        middle_x, middle_y = _HALF * (x0 + x1), _HALF * (y0 + y1)
        half_x, half_y = _HALF * (x1 - x0), _HALF * (y1 - y0)
        count = 0
        scan, scan_end = tile_start[tile], tile_start[tile + 1]
        for group in range(first, last, GROUP):
            size = min(GROUP, last - group)
            lanes_used = ((size + LANES - 1) // LANES) * LANES
            for x in range(lanes_used):
                p = order[group + min(x, size - 1)]
                M[x] = screen[p, 0]
                M[GROUP + x] = screen[p, 1]
                M[2 * GROUP + x] = screen[p, 2]
                M[3 * GROUP + x] = _ONE if x < size else _ZERO
                M[4 * GROUP + x] = max(best[p], _T_MIN)
            blocks = lanes_used // LANES
            k = 0
            while True:
                # The list is culled lazily, as far as some group of the cell traverses it.
                while count <= k and scan < scan_end:
                    i = tile_ids[scan]
                    scan += 1
                    if (
                        bounds[i, 0] <= x1
                        and bounds[i, 2] >= x0
                        and bounds[i, 1] <= y1
                        and bounds[i, 3] >= y0
                        and rows[i, 14] <= deepest
                        and not _strip_misses(bounds, i, middle_x, middle_y, half_x, half_y)
                    ):
                        near[count] = i
                        count += 1
                if k >= count:
                    break
                i = near[k]
                k += 1
                u, v = rows[i, 0], rows[i, 1]
                qa, qb, qc = rows[i, 2], rows[i, 3], rows[i, 4]
                px, py = rows[i, 5], rows[i, 6]
                r, s, t = rows[i, 7], rows[i, 8], rows[i, 9]
                z, a0, opacity = rows[i, 10], rows[i, 11], rows[i, 12]
                reach, begin_z = rows[i, 13], rows[i, 14]
                for h in range(blocks):
                    # The bit mask proves that the index is not negative, which allows SIMD code.
                    b = (h & 3) * LANES
                    for x in range(LANES):
                        dx = M[b + x] - u
                        dy = M[GROUP + b + x] - v
                        depth = M[2 * GROUP + b + x]
                        num = (dx * qa + dy * qb) * dx + dy * dy * qc
                        den = (dx * r + dy * s + _TWO * px) * dx + (dy * t + _TWO * py) * dy + _ONE
                        inverse = _ONE / den
                        foot = num * inverse
                        short = max((dx * px + dy * py + _ONE) * inverse * z - depth, _ZERO)
                        g = opacity * _exp_minus(_HALF * (foot + short * short * den * a0))
                        g = g if foot <= reach else _ZERO
                        g = g if depth >= begin_z else _ZERO
                        M[3 * GROUP + b + x] *= max(_ONE - g, _FACTOR_MIN)
                if (k & (CHECK_EVERY - 1)) == 0:
                    lead = -_ONE
                    for x in range(lanes_used):
                        lead = max(lead, M[3 * GROUP + x] - M[4 * GROUP + x])
                    if lead < _ZERO:
                        break
            for x in range(size):
                p = order[group + x]
                value = M[3 * GROUP + x]
                if value < _T_MIN:
                    value = _ZERO
                if value > best[p] or (value == best[p] and camera_index < winner[p]):
                    best[p] = value
                    winner[p] = camera_index
