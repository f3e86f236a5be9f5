# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled blending of tiles, front to back: nine feature channels, transmittance, depth.

For the depth, the contributors of each pixel (raw alpha, z-depth and sharpness of the peak) are
listed while the tile is blended, until a run of pixels lies wholly before the Gaussians that come;
the isosurface is then solved from the lists without evaluating any Gaussian again.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from ..compiled import inline, kernel
from .isosurface import (
    ALPHA,
    DEPTH,
    LIST_VALUES,
    PEAK,
    SHARPEST,
    SHARPNESS,
    SLOPE,
    SOLVER_END,
    TRANSMITTANCE,
    append_run,
    solve_run_8,
    solve_run_16,
)
from .raster_math import (
    ALPHA_MAX,
    ALPHA_MIN,
    COLUMN_OFFSETS,
    DENOMINATOR_MIN,
    FAR,
    FEATURES,
    FRONT_SIGMAS,
    HALF,
    ISO_LEVEL,
    LIVENESS_EVERY,
    ONE,
    PLANE,
    PREFETCH_AHEAD,
    REACH_SIGMAS,
    TILE,
    TRANSMITTANCE_MIN,
    TWO,
    ZERO,
    exp_short,
)
from .vector_runs import max_run, positive_run, prefetch_row, sum_columns

# Planes of the scratch array behind those of the solver: features, then the strongest Gaussian.
_F0 = SOLVER_END
_F1, _F2, _F3, _F4 = _F0 + PLANE, _F0 + 2 * PLANE, _F0 + 3 * PLANE, _F0 + 4 * PLANE
_F5, _F6, _F7, _F8 = _F0 + 5 * PLANE, _F0 + 6 * PLANE, _F0 + 7 * PLANE, _F0 + 8 * PLANE
_BEST = _F0 + FEATURES * PLANE
_BEST_AT = _BEST + PLANE
_SUMS = _BEST_AT + PLANE
_LARGEST = _SUMS + TILE
FORWARD_SCRATCH = _LARGEST + TILE


@inline
def _blend_run(
    lanes: Any, depth: Any, weights: Any, m: Any, b: Any, place: Any,
    left: Any, dy: Any, qa: Any, qb: Any, qc: Any, px: Any, py: Any, r: Any, s: Any, t: Any,
    z: Any, opacity: Any, a0: Any,
    f0: Any, f1: Any, f2: Any, f3: Any, f4: Any, f5: Any, f6: Any, f7: Any, f8: Any,
) -> None:  # fmt: skip
    """Blend one Gaussian into one run of pixels."""
    n1 = qb * dy
    n0 = qc * dy * dy
    d1 = TWO * px + s * dy
    d0 = ONE + (TWO * py + t * dy) * dy
    l0 = ONE + py * dy
    for x in range(lanes):
        dx = COLUMN_OFFSETS[x] - left
        num = max((dx * qa + n1) * dx + n0, ZERO)
        den = max((dx * r + d1) * dx + d0, DENOMINATOR_MIN)
        inverse = ONE / den
        raw = exp_short(HALF * num * inverse) * opacity
        alpha = min(raw, ALPHA_MAX)
        before = m[TRANSMITTANCE + b + x]
        contributes = (alpha >= ALPHA_MIN) & (before >= TRANSMITTANCE_MIN)
        weight = alpha * before if contributes else ZERO
        m[TRANSMITTANCE + b + x] = before - weight
        m[_F0 + b + x] += weight * f0
        m[_F1 + b + x] += weight * f1
        m[_F2 + b + x] += weight * f2
        m[_F3 + b + x] += weight * f3
        m[_F4 + b + x] += weight * f4
        m[_F5 + b + x] += weight * f5
        m[_F6 + b + x] += weight * f6
        m[_F7 + b + x] += weight * f7
        m[_F8 + b + x] += weight * f8
        if depth:
            raw = raw if contributes else ZERO
            sharpness = a0 * den
            m[ALPHA + b + x] = raw
            m[PEAK + b + x] = (dx * px + l0) * inverse * z
            m[SHARPNESS + b + x] = sharpness
            largest = m[SHARPEST + b + x]
            m[SHARPEST + b + x] = max(largest, sharpness if contributes else ZERO)
        if weights:
            best = m[_BEST + b + x]
            stronger = weight > best
            m[_BEST + b + x] = weight if stronger else best
            at = m[_BEST_AT + b + x]
            m[_BEST_AT + b + x] = place if stronger else at
            m[_SUMS + x] += weight
            m[_LARGEST + x] = max(m[_LARGEST + x], weight)


@functools.cache
def forward_kernel(lanes: int, depth: bool, weights: bool) -> Any:
    """Return the blending kernel for runs of ``lanes`` pixels, compiled on first call.

    Parameters
    ----------
    lanes : int
        8 or 16.
    depth : bool
        Also solve the isosurface.
    weights : bool
        Also gather the blending weights per pair and the strongest Gaussian per pixel.
    """
    halves = TILE // lanes

    @kernel(fast=True)
    def forward_range(
        first_tile: int,
        end_tile: int,
        params: np.ndarray,
        start: np.ndarray,
        gaussian_ids: np.ndarray,
        pair_slots: np.ndarray,
        ranges: np.ndarray,
        rows: np.ndarray,
        tiles_x: int,
        width: int,
        height: int,
        background: np.ndarray,
        limit: float,
        m: np.ndarray,
        lists: np.ndarray,
        color: np.ndarray,
        normal: np.ndarray,
        geometric: np.ndarray,
        alpha_image: np.ndarray,
        depth_image: np.ndarray,
        slope_image: np.ndarray,
        pair_weights: np.ndarray,
        strongest: np.ndarray,
    ) -> int:
        """Render tiles; return the first one that was not, where the lists are too short."""
        capacity = len(lists) // (LIST_VALUES * PLANE)
        far = np.zeros(2 * TILE, np.float32)
        reach = np.zeros(2 * TILE, np.float32)
        nearest = np.zeros(2 * TILE, np.float32)
        counts = np.zeros(PLANE, np.uint32)
        for tile in range(first_tile, end_tile):
            begin = start[tile]
            count = start[tile + 1] - begin
            tile_y = tile // tiles_x * TILE
            tile_x = tile % tiles_x * TILE
            origin_y = np.float32(tile_y) + HALF
            origin_x = np.float32(tile_x) + HALF
            live_rows = min(height - tile_y, TILE)
            live_columns = min(width - tile_x, TILE)
            for p in range(FORWARD_SCRATCH):
                m[p] = ZERO
            # Pixels outside the image start opaque, so nothing contributes to them.
            for row in range(live_rows):
                for column in range(live_columns):
                    m[TRANSMITTANCE + row * TILE + column] = ONE
            for p in range(2 * TILE):
                far[p] = FAR
                reach[p] = ZERO
                nearest[p] = FAR
            for p in range(PLANE):
                counts[p] = 0
            low, high = 0, live_rows - 1
            for k in range(count):
                ahead = begin + min(k + PREFETCH_AHEAD, count - 1)
                prefetch_row(params, np.int64(gaussian_ids[ahead]))
                first: Any = max(np.int64(rows[begin + k, 0]), low)
                last: Any = min(np.int64(rows[begin + k, 1]), high)
                if weights:
                    for x in range(TILE):
                        m[_SUMS + x] = ZERO
                        m[_LARGEST + x] = ZERO
                i = gaussian_ids[begin + k]
                q = params[i]
                u = q[0] - origin_x
                v = q[1] - origin_y
                z = q[10]
                front = z - FRONT_SIGMAS * q[22]
                back = z + REACH_SIGMAS * q[22]
                place = np.float32(k)
                first_column: Any = max(np.int64(ranges[i, 2]) - tile_x, 0)
                last_column: Any = min(np.int64(ranges[i, 3]) - tile_x, TILE - 1)
                first_half = first_column // lanes
                last_half = last_column // lanes
                for row in range(first, last + 1):
                    dy = np.float32(row) - v
                    for half in range(first_half, last_half + 1):
                        # The masks prove to LLVM that the index is not negative.
                        b = (row & (TILE - 1)) * TILE + (half & (halves - 1)) * lanes
                        left = u - np.float32((half & (halves - 1)) * lanes)
                        _blend_run(
                            lanes, depth, weights, m, b, place, left, dy,
                            q[2], q[3], q[4], q[5], q[6], q[7], q[8], q[9], z, q[11], q[12],
                            q[13], q[14], q[15], q[16], q[17], q[18], q[19], q[20], q[21],
                        )  # fmt: skip
                if depth:
                    # Apart from the loop above, whose iterations would wait for its branches.
                    for row in range(first, last + 1):
                        for half in range(first_half, last_half + 1):
                            run = (row & (TILE - 1)) * halves + (half & (halves - 1))
                            if front < far[run]:
                                b = (row & (TILE - 1)) * TILE + (half & (halves - 1)) * lanes
                                pixels = positive_run(lanes, m, ALPHA + b)
                                at = run * (capacity * LIST_VALUES * lanes)
                                append_run(lanes, m, b, pixels, lists, counts, at)
                                nearest[run] = min(nearest[run], front)
                                reach[run] = max(reach[run], back)
                if weights:
                    slot = pair_slots[begin + k]
                    pair_weights[slot, 0] = sum_columns(m, _SUMS)
                    pair_weights[slot, 1] = max_run(TILE, m, _LARGEST)
                if k % LIVENESS_EVERY == LIVENESS_EVERY - 1:
                    if depth:
                        longest = np.uint32(0)
                        for p in range(PLANE):
                            longest = max(longest, counts[p])
                        if np.int64(longest) + LIVENESS_EVERY > capacity:
                            return tile
                        for run in range(TILE * halves):
                            b = (run & (2 * TILE - 1)) * lanes
                            if max_run(lanes, m, TRANSMITTANCE + b) <= ISO_LEVEL:
                                far[run] = min(far[run], reach[run])
                    while low <= high:
                        if max_run(TILE, m, TRANSMITTANCE + low * TILE) >= TRANSMITTANCE_MIN:
                            break
                        low += 1
                    while high >= low:
                        if max_run(TILE, m, TRANSMITTANCE + high * TILE) >= TRANSMITTANCE_MIN:
                            break
                        high -= 1
                    if low > high:
                        break
            if depth:
                for run in range(live_rows * halves):
                    b = (run & (2 * TILE - 1)) * lanes
                    at = run * (capacity * LIST_VALUES * lanes)
                    if lanes == 16:
                        solve_run_16(m, b, lists, counts, at, nearest[run], limit)
                    else:
                        solve_run_8(m, b, lists, counts, at, nearest[run], limit)
            for row in range(live_rows):
                y = tile_y + row
                for column in range(live_columns):
                    x = tile_x + column
                    b = row * TILE + column
                    through = m[TRANSMITTANCE + b]
                    color[y, x, 0] = m[_F0 + b] + through * background[0]
                    color[y, x, 1] = m[_F1 + b] + through * background[1]
                    color[y, x, 2] = m[_F2 + b] + through * background[2]
                    normal[y, x, 0] = m[_F3 + b]
                    normal[y, x, 1] = m[_F4 + b]
                    normal[y, x, 2] = m[_F5 + b]
                    geometric[y, x, 0] = m[_F6 + b]
                    geometric[y, x, 1] = m[_F7 + b]
                    geometric[y, x, 2] = m[_F8 + b]
                    alpha_image[y, x] = ONE - through
                    if depth:
                        depth_image[y, x] = m[DEPTH + b]
                        slope_image[y, x] = m[SLOPE + b]
                    if weights:
                        strongest[y, x] = -1
                        if m[_BEST + b] > ZERO:
                            strongest[y, x] = gaussian_ids[begin + np.int64(m[_BEST_AT + b])]
        return end_tile

    return forward_range
