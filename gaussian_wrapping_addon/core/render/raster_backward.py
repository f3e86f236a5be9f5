# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled gradient of the blending and of the isosurface depth, front to back.

One scalar per pixel replaces the list of contributors: with ``q_i`` the loss gradient along
Gaussian i's features, ``remaining = sum_{j > i} w_j q_j + ...`` starts from the images and is
used up on the way (kernels.md 4.8). The depth's gradient is that of the implicit function: each
contributor adds ``g / a dlog(1 - G_i(t))`` (method.md 2.5). Per Gaussian and tile only moments of
the gradient on ``num``, ``den`` and ``1 + p.d`` are summed over pixels; the gradient on the row of
params follows from them (kernels.md 4.9). Each pair writes its own slot, so the sum per Gaussian
has a fixed order.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from ..compiled import inline, kernel
from .raster_math import (
    ALPHA_MAX,
    ALPHA_MIN,
    COLUMN_OFFSETS,
    DENOMINATOR_MIN,
    FRONT_SIGMAS,
    HALF,
    LIVENESS_EVERY,
    ONE,
    PLANE,
    PREFETCH_AHEAD,
    ROW_VALUES,
    TILE,
    TRANSMITTANCE_MIN,
    TWO,
    ZERO,
    exp_short,
    exp_wide,
)
from .vector_runs import max_run, prefetch_row

ABS_U, ABS_V = 22, 23
"""Columns of the pair gradients that hold sums of absolute values, not gradients of params."""

# Planes of the scratch array.
_G0, _G1, _G2, _G3, _G4 = 0, PLANE, 2 * PLANE, 3 * PLANE, 4 * PLANE
_G5, _G6, _G7, _G8 = 5 * PLANE, 6 * PLANE, 7 * PLANE, 8 * PLANE
_TRANSMITTANCE = 9 * PLANE
_REMAINING = 10 * PLANE
_DEPTH = 11 * PLANE
_PULL = 12 * PLANE
"""Loss gradient on the depth over the slope of log T there."""
# Sums per column of the tile, for one Gaussian.
_SUMS = 13 * PLANE
_NUM, _NUM_Y, _NUM_YY = _SUMS, _SUMS + TILE, _SUMS + 2 * TILE
_DEN, _DEN_Y, _DEN_YY = _SUMS + 3 * TILE, _SUMS + 4 * TILE, _SUMS + 5 * TILE
_LIN, _LIN_Y = _SUMS + 6 * TILE, _SUMS + 7 * TILE
_DISTANCE = _SUMS + 8 * TILE
_ALONG = _SUMS + 9 * TILE
_S0, _S1, _S2 = _SUMS + 10 * TILE, _SUMS + 11 * TILE, _SUMS + 12 * TILE
_S3, _S4, _S5 = _SUMS + 13 * TILE, _SUMS + 14 * TILE, _SUMS + 15 * TILE
_S6, _S7, _S8 = _SUMS + 16 * TILE, _SUMS + 17 * TILE, _SUMS + 18 * TILE
_SIZE_U, _SIZE_V = _SUMS + 19 * TILE, _SUMS + 20 * TILE
_SUM_ROWS = 21
BACKWARD_SCRATCH = _SUMS + _SUM_ROWS * TILE


@inline
def _gradient_run(
    lanes: Any, depth: Any, absolute: Any, m: Any, b: Any, c: Any,
    left: Any, dy: Any, qa: Any, qb: Any, qc: Any, px: Any, py: Any, r: Any, s: Any, t: Any,
    z: Any, opacity: Any, a0: Any,
    f0: Any, f1: Any, f2: Any, f3: Any, f4: Any, f5: Any, f6: Any, f7: Any, f8: Any,
) -> None:  # fmt: skip
    """Add one run of pixels to the sums of one Gaussian; ``c`` is the run's first column."""
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
        distance = num * inverse
        raw = exp_short(HALF * distance) * opacity
        alpha = min(raw, ALPHA_MAX)
        before = m[_TRANSMITTANCE + b + x]
        contributes = (alpha >= ALPHA_MIN) & (before >= TRANSMITTANCE_MIN)
        alpha = alpha if contributes else ZERO
        weight = alpha * before
        q = (
            m[_G0 + b + x] * f0 + m[_G1 + b + x] * f1 + m[_G2 + b + x] * f2
            + m[_G3 + b + x] * f3 + m[_G4 + b + x] * f4 + m[_G5 + b + x] * f5
            + m[_G6 + b + x] * f6 + m[_G7 + b + x] * f7 + m[_G8 + b + x] * f8
        )  # fmt: skip
        remaining = m[_REMAINING + b + x] - weight * q
        m[_REMAINING + b + x] = remaining
        m[_TRANSMITTANCE + b + x] = before - weight
        g_alpha = before * q - remaining / (ONE - alpha)
        g_distance = -HALF * alpha * g_alpha
        g_distance = g_distance if raw < ALPHA_MAX else ZERO
        if depth:
            peak = (dx * px + l0) * inverse * z
            ahead = max(peak - m[_DEPTH + b + x], ZERO)
            sharpness = a0 * den
            density = raw * exp_wide(HALF * sharpness * ahead * ahead)
            density = density if contributes else ZERO
            free = density < ALPHA_MAX
            density = min(density, ALPHA_MAX)
            # On log G, through log(1 - G).
            g_log = -m[_PULL + b + x] * density / (ONE - density)
            g_log = g_log if free else ZERO
            g_distance -= HALF * g_log
            g_peak = -g_log * sharpness * ahead
            g_sharpness = -HALF * g_log * ahead * ahead
            g_num = g_distance * inverse
            g_den = a0 * g_sharpness - (g_num * distance + g_peak * peak * inverse)
            g_lin = g_peak * inverse * z
            m[_LIN + c + x] += g_lin
            m[_LIN_Y + c + x] += g_lin * dy
            m[_ALONG + c + x] += g_sharpness * den
        else:
            g_num = g_distance * inverse
            g_den = -(g_num * distance)
        m[_NUM + c + x] += g_num
        m[_NUM_Y + c + x] += g_num * dy
        m[_NUM_YY + c + x] += g_num * dy * dy
        m[_DEN + c + x] += g_den
        m[_DEN_Y + c + x] += g_den * dy
        m[_DEN_YY + c + x] += g_den * dy * dy
        m[_DISTANCE + c + x] += g_distance
        if absolute:
            g_u = g_num * (TWO * qa * dx + n1) + g_den * (TWO * r * dx + d1)
            g_v = g_num * (TWO * qc * dy + qb * dx) + g_den * (TWO * (py + t * dy) + s * dx)
            if depth:
                g_u += g_lin * px
                g_v += g_lin * py
            m[_SIZE_U + c + x] += abs(g_u)
            m[_SIZE_V + c + x] += abs(g_v)
        m[_S0 + c + x] += weight * m[_G0 + b + x]
        m[_S1 + c + x] += weight * m[_G1 + b + x]
        m[_S2 + c + x] += weight * m[_G2 + b + x]
        m[_S3 + c + x] += weight * m[_G3 + b + x]
        m[_S4 + c + x] += weight * m[_G4 + b + x]
        m[_S5 + c + x] += weight * m[_G5 + b + x]
        m[_S6 + c + x] += weight * m[_G6 + b + x]
        m[_S7 + c + x] += weight * m[_G7 + b + x]
        m[_S8 + c + x] += weight * m[_G8 + b + x]


@inline
def _write_pair(depth: Any, absolute: Any, m: Any, u: Any, q: Any, out: Any) -> None:
    """Turn the sums of one Gaussian in one tile into the gradient on its row of params."""
    num = num_x = num_xx = num_y = num_xy = num_yy = ZERO
    den = den_x = den_xx = den_y = den_xy = den_yy = ZERO
    lin = lin_x = lin_y = distance = along = ZERO
    for x in range(TILE):
        dx = COLUMN_OFFSETS[x] - u
        value = m[_NUM + x]
        first = value * dx
        num += value
        num_x += first
        num_xx += first * dx
        value = m[_NUM_Y + x]
        num_y += value
        num_xy += value * dx
        num_yy += m[_NUM_YY + x]
        value = m[_DEN + x]
        first = value * dx
        den += value
        den_x += first
        den_xx += first * dx
        value = m[_DEN_Y + x]
        den_y += value
        den_xy += value * dx
        den_yy += m[_DEN_YY + x]
        distance += m[_DISTANCE + x]
    if depth:
        for x in range(TILE):
            dx = COLUMN_OFFSETS[x] - u
            value = m[_LIN + x]
            lin += value
            lin_x += value * dx
            lin_y += m[_LIN_Y + x]
            along += m[_ALONG + x]
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = ZERO
    for x in range(TILE):
        s0 += m[_S0 + x]
        s1 += m[_S1 + x]
        s2 += m[_S2 + x]
        s3 += m[_S3 + x]
        s4 += m[_S4 + x]
        s5 += m[_S5 + x]
        s6 += m[_S6 + x]
        s7 += m[_S7 + x]
        s8 += m[_S8 + x]
    qa, qb, qc, px, py, r, s, t = q[2], q[3], q[4], q[5], q[6], q[7], q[8], q[9]
    out[0] = -(
        TWO * (qa * num_x + px * den + r * den_x) + qb * num_y + s * den_y + px * lin
    )  # fmt: skip
    out[1] = -(
        TWO * (qc * num_y + py * den + t * den_y) + qb * num_x + s * den_x + py * lin
    )  # fmt: skip
    out[2], out[3], out[4] = num_xx, num_xy, num_yy
    out[5], out[6] = TWO * den_x + lin_x, TWO * den_y + lin_y
    out[7], out[8], out[9] = den_xx, den_xy, den_yy
    out[10] = (lin + px * lin_x + py * lin_y) / q[10]
    out[11] = -TWO * distance / q[11]
    out[12] = along
    out[13], out[14], out[15] = s0, s1, s2
    out[16], out[17], out[18] = s3, s4, s5
    out[19], out[20], out[21] = s6, s7, s8
    size_u = size_v = ZERO
    if absolute:
        for x in range(TILE):
            size_u += m[_SIZE_U + x]
            size_v += m[_SIZE_V + x]
    out[ABS_U], out[ABS_V] = size_u, size_v


@functools.cache
def backward_kernel(lanes: int, depth: bool, absolute: bool) -> Any:
    """Return the gradient kernel for runs of ``lanes`` pixels, compiled on first call.

    Parameters
    ----------
    lanes : int
        8 or 16.
    depth : bool
        Also the gradient of the depth image.
    absolute : bool
        Also sum the absolute gradients on (u, v) per pixel (AbsGS).
    """
    halves = TILE // lanes

    @kernel(fast=True)
    def backward_range(
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
        color: np.ndarray,
        normal: np.ndarray,
        geometric: np.ndarray,
        alpha_image: np.ndarray,
        depth_image: np.ndarray,
        slope_image: np.ndarray,
        g_color: np.ndarray,
        g_normal: np.ndarray,
        g_geometric: np.ndarray,
        g_alpha: np.ndarray,
        g_depth: np.ndarray,
        m: np.ndarray,
        pairs: np.ndarray,
    ) -> None:
        """Write the gradients of all pairs of the tiles at their slots of ``pairs (p, 24)``."""
        deepest = np.zeros(TILE, np.float32)
        for tile in range(first_tile, end_tile):
            begin = start[tile]
            count = start[tile + 1] - begin
            if count == 0:
                continue
            tile_y = tile // tiles_x * TILE
            tile_x = tile % tiles_x * TILE
            origin_y = np.float32(tile_y) + HALF
            origin_x = np.float32(tile_x) + HALF
            live_rows = min(height - tile_y, TILE)
            live_columns = min(width - tile_x, TILE)
            for p in range(_SUMS):
                m[p] = ZERO
            for row in range(live_rows):
                y = tile_y + row
                reach = ZERO
                for column in range(live_columns):
                    x = tile_x + column
                    b = row * TILE + column
                    g0, g1, g2 = g_color[y, x, 0], g_color[y, x, 1], g_color[y, x, 2]
                    g3, g4, g5 = g_normal[y, x, 0], g_normal[y, x, 1], g_normal[y, x, 2]
                    g6, g7, g8 = g_geometric[y, x, 0], g_geometric[y, x, 1], g_geometric[y, x, 2]
                    m[_G0 + b], m[_G1 + b], m[_G2 + b] = g0, g1, g2
                    m[_G3 + b], m[_G4 + b], m[_G5 + b] = g3, g4, g5
                    m[_G6 + b], m[_G7 + b], m[_G8 + b] = g6, g7, g8
                    # The colour holds the background, so its part of the final T is included.
                    m[_REMAINING + b] = (
                        g0 * color[y, x, 0] + g1 * color[y, x, 1] + g2 * color[y, x, 2]
                        + g3 * normal[y, x, 0] + g4 * normal[y, x, 1] + g5 * normal[y, x, 2]
                        + g6 * geometric[y, x, 0] + g7 * geometric[y, x, 1]
                        + g8 * geometric[y, x, 2]
                        - g_alpha[y, x] * (ONE - alpha_image[y, x])
                    )  # fmt: skip
                    m[_TRANSMITTANCE + b] = ONE
                    if depth:
                        at = depth_image[y, x]
                        if at > ZERO and g_depth[y, x] != ZERO:
                            m[_DEPTH + b] = at
                            m[_PULL + b] = g_depth[y, x] / slope_image[y, x]
                            reach = max(reach, at)
                deepest[row] = reach
            low, high = 0, live_rows - 1
            for k in range(count):
                ahead = begin + min(k + PREFETCH_AHEAD, count - 1)
                prefetch_row(params, np.int64(gaussian_ids[ahead]))
                prefetch_row(pairs, np.int64(pair_slots[ahead]))
                first: Any = max(np.int64(rows[begin + k, 0]), low)
                last: Any = min(np.int64(rows[begin + k, 1]), high)
                out = pairs[pair_slots[begin + k]]
                if first > last:
                    for column in range(ROW_VALUES):
                        out[column] = ZERO
                else:
                    i = gaussian_ids[begin + k]
                    q = params[i]
                    u = q[0] - origin_x
                    v = q[1] - origin_y
                    z = q[10]
                    front = z - FRONT_SIGMAS * q[22]
                    first_column: Any = max(np.int64(ranges[i, 2]) - tile_x, 0)
                    last_column: Any = min(np.int64(ranges[i, 3]) - tile_x, TILE - 1)
                    first_half = first_column // lanes
                    last_half = last_column // lanes
                    for p in range(_SUM_ROWS * TILE):
                        m[_SUMS + p] = ZERO
                    reach = ZERO
                    for row in range(first, last + 1):
                        reach = max(reach, deepest[row & (TILE - 1)])
                    if depth and front < reach:
                        for row in range(first, last + 1):
                            dy = np.float32(row) - v
                            for half in range(first_half, last_half + 1):
                                # The masks prove to LLVM that the index is not negative.
                                c = (half & (halves - 1)) * lanes
                                _gradient_run(
                                    lanes, True, absolute, m, (row & (TILE - 1)) * TILE + c, c,
                                    u - np.float32(c), dy,
                                    q[2], q[3], q[4], q[5], q[6], q[7], q[8], q[9], z, q[11], q[12],
                                    q[13], q[14], q[15], q[16], q[17], q[18], q[19], q[20], q[21],
                                )  # fmt: skip
                    else:
                        for row in range(first, last + 1):
                            dy = np.float32(row) - v
                            for half in range(first_half, last_half + 1):
                                c = (half & (halves - 1)) * lanes
                                _gradient_run(
                                    lanes, False, absolute, m, (row & (TILE - 1)) * TILE + c, c,
                                    u - np.float32(c), dy,
                                    q[2], q[3], q[4], q[5], q[6], q[7], q[8], q[9], z, q[11], q[12],
                                    q[13], q[14], q[15], q[16], q[17], q[18], q[19], q[20], q[21],
                                )  # fmt: skip
                    _write_pair(depth, absolute, m, u, q, out)
                if k % LIVENESS_EVERY == LIVENESS_EVERY - 1:
                    while low <= high:
                        if max_run(TILE, m, _TRANSMITTANCE + low * TILE) >= TRANSMITTANCE_MIN:
                            break
                        low += 1
                    while high >= low:
                        if max_run(TILE, m, _TRANSMITTANCE + high * TILE) >= TRANSMITTANCE_MIN:
                            break
                        high -= 1

    return backward_range


@kernel(fast=False)
def sum_pairs(
    first: int,
    end: int,
    pairs: np.ndarray,
    pair_offsets: np.ndarray,
    grad_params: np.ndarray,
    grad_px: np.ndarray,
    grad_abs_px: np.ndarray,
) -> None:
    """Sum the pair gradients of the Gaussians ``first .. end`` into ``grad_params (n, 24)``.

    Columns 22 and 23 become 0; ``grad_px (n,)`` and ``grad_abs_px (n,)`` receive the lengths of
    the gradient on (u, v) and of its sum of absolute values.
    """
    total = np.zeros(ROW_VALUES, np.float32)
    for i in range(first, end):
        total[:] = ZERO
        for slot in range(pair_offsets[i], pair_offsets[i + 1]):
            for column in range(ROW_VALUES):
                total[column] += pairs[slot, column]
        grad_px[i] = math.sqrt(total[0] * total[0] + total[1] * total[1])
        grad_abs_px[i] = math.sqrt(total[ABS_U] * total[ABS_U] + total[ABS_V] * total[ABS_V])
        total[ABS_U] = ZERO
        total[ABS_V] = ZERO
        for column in range(ROW_VALUES):
            grad_params[i, column] = total[column]


@kernel(fast=False)
def sum_weights(
    first: int,
    end: int,
    pair_weights: np.ndarray,
    pair_offsets: np.ndarray,
    weight_sum: np.ndarray,
    weight_max: np.ndarray,
) -> None:
    """Combine the blending weights of the pairs of the Gaussians ``first .. end``."""
    for i in range(first, end):
        total = ZERO
        largest = ZERO
        for slot in range(pair_offsets[i], pair_offsets[i + 1]):
            total += pair_weights[slot, 0]
            largest = max(largest, pair_weights[slot, 1])
        weight_sum[i] = total
        weight_max[i] = largest
