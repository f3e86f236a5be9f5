# SPDX-License-Identifier: GPL-3.0-or-later
"""Lists of the Gaussians that touch each tile of 16 x 16 pixels, in blending order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import tolerances
from ..errors import ResourceError
from ..parallel import default_threads, even_bounds, run_chunks
from .projection import ScreenGaussians
from .tile_kernels import list_range, radix_order, scatter_range, span_range

_MAX_PAIRS = 2**31 - 1


@dataclass(frozen=True)
class TileLists:
    """For each tile, the Gaussians whose ellipse ``alpha >= 1/255`` reaches it, nearest first.

    Tiles are numbered row by row. A *pair* is one (tile, Gaussian); *slots* number the pairs so
    that those of one Gaussian are contiguous, which is where per-pair gradients are written.
    """

    start: np.ndarray
    """(tiles + 1,) int64: the pairs of tile t are ``start[t] .. start[t + 1]``."""
    gaussian_ids: np.ndarray
    """(pairs,) int32, by increasing distance within a tile, ties by index."""
    pair_slots: np.ndarray
    """(pairs,) int32: slot of each pair."""
    pair_offsets: np.ndarray
    """(n + 1,) int64: the slots of Gaussian i are ``pair_offsets[i] .. pair_offsets[i + 1]``."""
    pixel_ranges: np.ndarray
    """(n, 4) int32: first and last row, first and last column of pixels whose centre lies in the
    box, inside the image; empty (first > last) where not visible."""
    tiles_x: int
    tiles_y: int


def bin_gaussians(screen: ScreenGaussians, width: int, height: int, threads: int = 0) -> TileLists:
    """Sort the visible Gaussians by distance and scatter them into tile lists (kernels.md 8).

    One radix sort of the distances and one counting sort into tiles; the order within each tile
    is that of a stable sort, whatever the number of threads. In tiles at the corners of a box that
    the ellipse itself does not reach, the Gaussian is left out.

    Parameters
    ----------
    screen : ScreenGaussians
        Projected for an image of ``width`` x ``height`` pixels.
    threads : int
        0 uses every core.

    Raises
    ------
    ResourceError
        If the lists would hold more than 2^31 - 1 pairs.
    """
    threads = threads or default_threads()
    count = len(screen)
    tile = tolerances.TILE_PX
    tiles_x, tiles_y = -(-width // tile), -(-height // tile)
    ranges = np.zeros((count, 4), np.int32)
    pair_counts = np.zeros(count, np.int64)

    def spans(begin: int, end: int) -> None:
        span_range(
            begin,
            end,
            screen.boxes,
            screen.skews,
            screen.visible,
            width,
            height,
            ranges,
            pair_counts,
        )

    run_chunks(spans, even_bounds(count, threads), threads)
    pair_offsets = np.zeros(count + 1, np.int64)
    np.cumsum(pair_counts, out=pair_offsets[1:])
    pairs = int(pair_offsets[-1])
    if pairs > _MAX_PAIRS:
        raise ResourceError(
            f"{pairs} pairs of Gaussian and tile do not fit.", "Render a smaller image."
        )

    order = radix_order(screen.depths, screen.visible)
    rank_offsets = np.zeros(len(order) + 1, np.int64)
    np.cumsum(pair_counts[order], out=rank_offsets[1:])
    tiles = np.zeros(pairs, np.int32)  # of each pair, in blending order
    # Runs of the order are counted apart, so that each knows where it writes in every tile.
    bounds = even_bounds(len(order), threads, 1)
    heads = np.zeros((max(len(bounds) - 1, 1), tiles_x * tiles_y), np.int64)
    run_of = {int(begin): run for run, begin in enumerate(bounds[:-1])}

    def list_tiles(begin: int, end: int) -> None:
        counts = heads[run_of[begin]]
        boxes, skews = screen.boxes, screen.skews
        list_range(begin, end, order, rank_offsets, boxes, skews, ranges, tiles_x, tiles, counts)

    run_chunks(list_tiles, bounds, threads)
    start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    np.cumsum(heads.sum(0), out=start[1:])
    heads[1:] = start[:-1] + np.cumsum(heads[:-1], axis=0)
    heads[0] = start[:-1]
    gaussian_ids = np.zeros(pairs, np.int32)
    pair_slots = np.zeros(pairs, np.int32)

    def scatter(begin: int, end: int) -> None:
        scatter_range(
            begin,
            end,
            order,
            rank_offsets,
            pair_offsets,
            tiles,
            heads[run_of[begin]],
            gaussian_ids,
            pair_slots,
        )

    run_chunks(scatter, bounds, threads)
    return TileLists(start, gaussian_ids, pair_slots, pair_offsets, ranges, tiles_x, tiles_y)
