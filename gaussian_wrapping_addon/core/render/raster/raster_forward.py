# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled forward pass of tiles, front to back: nine feature channels, transmittance, depth.

The Gaussians of a tile are first listed for each block of pixels that their ellipses reach; each
block is then blended with its state in registers, and its isosurface is solved from the entries
that blending recorded, without evaluating any Gaussian again.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from ...kernels.compiled import kernel
from ..isosurface.isosurface import solve_block
from ..isosurface.isosurface_steps import SOLVER_VALUES
from ..simd.raster_math import (
    BEST,
    BEST_AT,
    BLOCK_COLUMNS,
    BLOCK_WIDTH,
    FAR,
    FORWARD_PLANES,
    FRONT_SIGMAS,
    HALF,
    ONE,
    PLANE,
    STRIDE,
    TILE,
    TRANSMITTANCE,
    ZERO,
)
from ..simd.vector_runs import prefetch_row, prefetch_row_early
from .contributors import CONTRIBUTORS_PADDING, list_contributors
from .forward_block import blend_block
from .tile_io import write_row

FORWARD_SCRATCH = FORWARD_PLANES * STRIDE + SOLVER_VALUES


@functools.cache
def forward_kernel(lanes: int, depth: bool, weights: bool) -> Any:
    """Return the blending kernel for blocks of ``lanes`` pixels, compiled on first call.

    Parameters
    ----------
    lanes : int
        8 or 16.
    depth : bool
        Also solve the isosurface.
    weights : bool
        Also collect the blending weights per intersection and the strongest Gaussian per pixel.
    """
    blocks = PLANE // lanes
    block_height = lanes // BLOCK_WIDTH

    @kernel(fast=True)
    def forward_range(
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
        background: np.ndarray,
        limit: float,
        m: np.ndarray,
        lists: np.ndarray,
        contributors: np.ndarray,
        color: np.ndarray,
        normal: np.ndarray,
        geometric: np.ndarray,
        alpha_image: np.ndarray,
        depth_image: np.ndarray,
        slope_image: np.ndarray,
        intersection_weights: np.ndarray,
        strongest: np.ndarray,
    ) -> None:
        """Render tiles.

        ``lists`` and, for each block, ``contributors`` have room for the longest tile list.
        """
        longest: Any = 0
        for tile in range(first_tile, end_tile):
            longest = max(longest, np.int64(start[tile + 1]) - np.int64(start[tile]))
        capacity = longest + CONTRIBUTORS_PADDING
        counts = np.zeros(blocks, np.int64)
        nearest_depths = np.zeros(longest + 1, np.float32)
        images = (color, normal, geometric, alpha_image, depth_image, slope_image)
        for tile in range(first_tile, end_tile):
            begin = np.int64(start[tile])
            count = np.int64(start[tile + 1]) - begin
            tile_y = tile // tiles_x * TILE
            tile_x = tile % tiles_x * TILE
            origin_y = np.float32(tile_y) + HALF
            origin_x = np.float32(tile_x) + HALF
            live_rows = min(height - tile_y, TILE)
            live_columns = min(width - tile_x, TILE)
            # The rest of the scratch array is written before it is read.
            for p in range(PLANE):
                m[TRANSMITTANCE * STRIDE + p] = ONE
            if live_rows < TILE or live_columns < TILE:
                # Pixels outside the image start opaque, so nothing contributes to them.
                for row in range(TILE):
                    for column in range(0 if row >= live_rows else live_columns, TILE):
                        m[
                            TRANSMITTANCE * STRIDE
                            + (row // block_height * BLOCK_COLUMNS + column // BLOCK_WIDTH) * lanes
                            + row % block_height * BLOCK_WIDTH
                            + column % BLOCK_WIDTH
                        ] = ZERO
            for k in range(begin, begin + count):
                prefetch_row(params, np.int64(gaussian_ids[k]))
                if weights:
                    intersection_weights[intersection_slots[k], 0] = ZERO
                    intersection_weights[intersection_slots[k], 1] = ZERO
            coming: Any = np.int64(start[min(tile + 2, end_tile)]) - begin - count
            list_contributors(lanes, masks, begin, count, capacity, contributors, counts)
            if depth:
                # Back to front: the nearest depth that an intersection or any later one reaches.
                nearest: Any = FAR
                nearest_depths[0] = FAR
                for k in range(count - 1, -1, -1):
                    i = np.int64(gaussian_ids[begin + k])
                    nearest = min(nearest, params[i, 10] - FRONT_SIGMAS * params[i, 22])
                    nearest_depths[k] = nearest
            for block in range(blocks):
                # Prefetch the rows of the next tile while this one is blended.
                next_k = begin + count + block * coming // blocks
                for k in range(next_k, begin + count + (block + 1) * coming // blocks):
                    prefetch_row_early(params, np.int64(gaussian_ids[k]))
                entries = blend_block(
                    lanes, depth, weights, m, block, params, gaussian_ids, intersection_slots,
                    contributors, block * capacity, counts[block], begin, origin_x, origin_y,
                    lists, nearest_depths, limit, intersection_weights,
                )  # fmt: skip
                if depth:
                    solve_block(lanes, m, block * lanes, lists, entries)
            for row in range(live_rows):
                y = tile_y + row
                offset = (
                    row // block_height * BLOCK_COLUMNS * lanes + row % block_height * BLOCK_WIDTH
                )
                at = y * width + tile_x
                write_row(lanes, depth, m, offset, live_columns, background, images, at)
                if weights:
                    for column in range(live_columns):
                        b = offset + column // BLOCK_WIDTH * lanes + column % BLOCK_WIDTH
                        strongest[y, tile_x + column] = -1
                        if m[BEST * STRIDE + b] > ZERO:
                            strongest[y, tile_x + column] = gaussian_ids[
                                begin + np.int64(m[BEST_AT * STRIDE + b])
                            ]

    return forward_range
