# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled backward pass of blending and isosurface depth, front to back.

One scalar per pixel replaces the list of contributors: with ``q_i`` the loss gradient along
Gaussian i's features, ``remaining = sum_{j > i} w_j q_j + ...`` starts from the images and is
reduced on the way. The depth's gradient is that of the implicit function: each contributor adds
``g / a dlog(1 - G_i(t))`` (docs/method.md, section 2.5). Per Gaussian and tile only moments of the
gradient on ``num``, ``den`` and ``1 + p.d`` are summed over pixels; the gradient on the row of
params follows from them. Each intersection writes its own slot, so the sum per Gaussian has a fixed
order. Blocks are processed as in the forward pass, a chunk of intersections at a time.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from ...kernels.compiled import inline, kernel
from ..simd.raster_math import (
    BLOCK_COLUMNS,
    BLOCK_WIDTH,
    FEATURES,
    HALF,
    LIVENESS_EVERY,
    PREFETCH_AHEAD,
    ROW_VALUES,
    STRIDE,
    TILE,
    TWO,
    ZERO,
)
from ..simd.vector_runs import prefetch_row
from .backward_block import (
    ALONG,
    BACKWARD_PLANES,
    BASE_SUMS,
    DEN,
    DEPTH_SUMS,
    DISTANCE,
    FEATURE,
    LIN,
    NUM,
    TRANSMITTANCE,
    sum_intersection_gradient,
)
from .contributors import active_blocks
from .tile_io import read_row

ABS_U, ABS_V = 22, 23
"""Columns of the intersection gradients with sums of absolute values instead of gradients."""

_SUMS = BACKWARD_PLANES * STRIDE
BACKWARD_SCRATCH = _SUMS + 2 * TILE


@inline
def _write_intersection(
    depth: Any, absolute: Any, m: Any, s: Any, params: Any, i: Any, out: Any, slot: Any
) -> None:  # fmt: skip
    """Turn an intersection's totals at ``m[s]`` into the gradient on its row of params."""
    qa, qb, qc = params[i, 2], params[i, 3], params[i, 4]
    px, py, qr, qs, qt = params[i, 5], params[i, 6], params[i, 7], params[i, 8], params[i, 9]
    den, den_x, den_y = m[s + DEN], m[s + DEN + 1], m[s + DEN + 2]
    num_x, num_y = m[s + NUM + 1], m[s + NUM + 2]
    lin = lin_x = lin_y = along = ZERO
    if depth:
        lin, lin_x, lin_y, along = m[s + LIN], m[s + LIN + 1], m[s + LIN + 2], m[s + ALONG]
    out[slot, 0] = -(
        TWO * (qa * num_x + px * den + qr * den_x) + qb * num_y + qs * den_y + px * lin
    )
    out[slot, 1] = -(
        TWO * (qc * num_y + py * den + qt * den_y) + qb * num_x + qs * den_x + py * lin
    )
    out[slot, 2], out[slot, 3], out[slot, 4] = m[s + NUM + 3], m[s + NUM + 4], m[s + NUM + 5]
    out[slot, 5], out[slot, 6] = TWO * den_x + lin_x, TWO * den_y + lin_y
    out[slot, 7], out[slot, 8], out[slot, 9] = m[s + DEN + 3], m[s + DEN + 4], m[s + DEN + 5]
    out[slot, 10] = (lin + px * lin_x + py * lin_y) / params[i, 10]
    out[slot, 11] = -TWO * m[s + DISTANCE] / params[i, 11]
    out[slot, 12] = along
    for feature in range(FEATURES):
        out[slot, 13 + feature] = m[s + FEATURE + feature]
    first = DEPTH_SUMS if depth else BASE_SUMS
    out[slot, ABS_U] = m[s + first] if absolute else ZERO
    out[slot, ABS_V] = m[s + first + 1] if absolute else ZERO


@functools.cache
def backward_kernel(lanes: int, depth: bool, absolute: bool) -> Any:
    """Return the gradient kernel for blocks of ``lanes`` pixels, compiled on first call.

    Parameters
    ----------
    lanes : int
        8 or 16.
    depth : bool
        Include the gradient of the depth image.
    absolute : bool
        Also sum the absolute gradients on (u, v) per pixel (AbsGS).
    """
    block_height = lanes // BLOCK_WIDTH

    @kernel(fast=True)
    def backward_range(
        first_tile: int,
        end_tile: int,
        params: np.ndarray,
        start: np.ndarray,
        gaussian_ids: np.ndarray,
        intersection_slots: np.ndarray,
        masks: np.ndarray,
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
        intersections: np.ndarray,
    ) -> None:
        """Write the gradients of the tiles' intersections to their slots, (p, 24)."""
        images = (color, normal, geometric, alpha_image, depth_image, slope_image)
        grads = (g_color, g_normal, g_geometric, g_alpha, g_depth)
        for tile in range(first_tile, end_tile):
            begin = np.int64(start[tile])
            count = np.int64(start[tile + 1]) - begin
            if count == 0:
                continue
            tile_y = tile // tiles_x * TILE
            tile_x = tile % tiles_x * TILE
            origin_y = np.float32(tile_y) + HALF
            origin_x = np.float32(tile_x) + HALF
            live_rows = min(height - tile_y, TILE)
            live_columns = min(width - tile_x, TILE)
            for row in range(TILE):
                offset = (
                    row // block_height * BLOCK_COLUMNS * lanes + row % block_height * BLOCK_WIDTH
                )
                inside = live_columns if row < live_rows else 0
                at = (tile_y + row) * width + tile_x
                read_row(lanes, depth, m, offset, inside, images, grads, at)
            live = np.uint64(0)
            for k in range(begin, begin + count):
                if (k - begin) % LIVENESS_EVERY == 0:
                    live = active_blocks(lanes, m, TRANSMITTANCE * STRIDE)
                ahead: Any = min(k + PREFETCH_AHEAD, begin + count - 1)
                prefetch_row(params, np.int64(gaussian_ids[ahead]))
                prefetch_row(intersections, np.int64(intersection_slots[ahead]))
                i = np.int64(gaussian_ids[k])
                slot = np.int64(intersection_slots[k])
                bits = np.uint64(masks[k]) & live
                sum_intersection_gradient(
                    lanes, depth, absolute, m, bits, params, i, origin_x, origin_y, _SUMS
                )
                _write_intersection(depth, absolute, m, _SUMS, params, i, intersections, slot)

    return backward_range


@kernel(fast=False)
def sum_intersections(
    first: int,
    end: int,
    intersections: np.ndarray,
    intersection_offsets: np.ndarray,
    grad_params: np.ndarray,
    grad_px: np.ndarray,
    grad_abs_px: np.ndarray,
) -> None:
    """Sum the intersection gradients of the Gaussians ``first .. end`` into ``grad_params``.

    Columns 22 and 23 of ``grad_params (n, 24)`` become 0; ``grad_px (n,)`` and ``grad_abs_px (n,)``
    receive the norms of the gradient on (u, v) and of its sum of absolute values.
    """
    total = np.zeros(ROW_VALUES, np.float32)
    for i in range(first, end):
        total[:] = ZERO
        for slot in range(intersection_offsets[i], intersection_offsets[i + 1]):
            for column in range(ROW_VALUES):
                total[column] += intersections[slot, column]
        grad_px[i] = math.sqrt(total[0] * total[0] + total[1] * total[1])
        grad_abs_px[i] = math.sqrt(total[ABS_U] * total[ABS_U] + total[ABS_V] * total[ABS_V])
        total[ABS_U] = ZERO
        total[ABS_V] = ZERO
        for column in range(ROW_VALUES):
            grad_params[i, column] = total[column]
