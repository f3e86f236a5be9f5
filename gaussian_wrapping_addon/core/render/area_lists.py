# SPDX-License-Identifier: GPL-3.0-or-later
"""Tile lists by area, and query positions sorted into cells.

The lists of :mod:`.tiles` hold the Gaussians that reach a pixel *centre* of a tile; one that passes
between the centres is rightly missing there. Queries at sub-pixel positions need these lists.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .. import limits
from ..compiled import kernel, part
from ..errors import ResourceError
from ..parallel import even_bounds, run_chunks
from .projection import ScreenGaussians
from .tiles import radix_order

TILE = limits.TILE_PX
_MAX_INTERSECTIONS = 2**31 - 1
# Margin for the rounding of float32 boxes and skews: in pixels, and relative to a half side.
PIXEL_MARGIN = 0.02
SHARE_MARGIN = 1e-6
_MAX_SHIFT = 2
_POSITIONS_PER_CELL = 14
"""Cells are subdivided while they hold this many positions on average: each costs one pass over its
tile's list, and shortens the list that its positions pass over."""


@dataclass(frozen=True)
class AreaLists:
    """For each tile, the Gaussians whose ellipse ``alpha >= 1/255`` reaches its area.

    Nearest first, ties by index. Tiles are numbered row by row. *Slots* number the tile
    intersections so that those of one Gaussian are contiguous.
    """

    start: np.ndarray  # (tiles + 1,) int64: tile t has the intersections start[t] .. start[t + 1]
    gaussian_ids: np.ndarray  # (intersections,) int32
    intersection_slots: np.ndarray  # (intersections,) int32
    intersection_offsets: np.ndarray  # (n + 1,) int64: the slots of Gaussian i
    tiles_x: int
    tiles_y: int


@dataclass(frozen=True)
class SortedPositions:
    """Positions inside the image, by cell; cells divide each tile ``2^shift`` times per axis."""

    coordinates: np.ndarray  # (k, 2) float32, pixels, sorted
    order: np.ndarray  # (k,) int32: index of each in the input
    start: np.ndarray  # (cells + 1,) int64; cells are numbered tile by tile
    shift: int
    input_count: int
    """Number of positions in the input."""


def list_areas(screen: ScreenGaussians, width: int, height: int, threads: int) -> AreaLists:
    """List, for each tile, the visible Gaussians that reach its area.

    The boxes are in pixels of an image of ``width`` x ``height``. Raises ResourceError if the lists
    would hold more than 2^31 - 1 intersections.
    """
    count = len(screen)
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    order = radix_order(screen.depths, screen.visible)
    intersection_offsets = np.zeros(count + 1, np.int64)
    # Each run of the order is counted separately, so that it knows its write offset in every tile.
    bounds = even_bounds(len(order), threads, 1)
    heads = np.zeros((max(len(bounds) - 1, 1), tiles_x * tiles_y), np.int64)
    run_of = {int(begin): run for run, begin in enumerate(bounds[:-1])}

    def walk(begin: int, end: int, ids: np.ndarray, slots: np.ndarray) -> None:
        scan_areas(
            begin, end, order, screen.boxes, screen.skews, tiles_x, tiles_y,
            heads[run_of[begin]], intersection_offsets, ids, slots,
        )  # fmt: skip

    nothing = np.zeros(0, np.int32)
    run_chunks(lambda begin, end: walk(begin, end, nothing, nothing), bounds, threads)
    np.cumsum(intersection_offsets, out=intersection_offsets)
    intersections = int(intersection_offsets[-1])
    if intersections > _MAX_INTERSECTIONS:
        raise ResourceError(
            f"{intersections} tile intersections do not fit.", "Query a smaller image."
        )
    start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    np.cumsum(heads.sum(0), out=start[1:])
    heads[1:] = start[:-1] + np.cumsum(heads[:-1], axis=0)
    heads[0] = start[:-1]
    gaussian_ids, intersection_slots = (
        np.zeros(intersections, np.int32),
        np.zeros(intersections, np.int32),
    )
    if intersections > 0:
        run_chunks(
            lambda begin, end: walk(begin, end, gaussian_ids, intersection_slots), bounds, threads
        )
    return AreaLists(
        start, gaussian_ids, intersection_slots, intersection_offsets, tiles_x, tiles_y
    )


def sort_positions(positions: np.ndarray, width: int, height: int) -> SortedPositions:
    """Sort (m, 2) positions by cell, stable within a cell; drop those outside the image.

    In pixels; the image is ``0 <= x <= width``, ``0 <= y <= height``, and NaN counts as outside.
    """
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    shift = 0
    while (
        shift < _MAX_SHIFT
        and (tiles_x * tiles_y) << (2 * shift + 2) <= len(positions) // _POSITIONS_PER_CELL
    ):
        shift += 1
    coordinates = np.ascontiguousarray(positions, np.float32)
    cells = np.empty(len(coordinates), np.int32)
    start = np.zeros((tiles_x * tiles_y << (2 * shift)) + 1, np.int64)
    find_cells(coordinates, width, height, tiles_x, tiles_y, shift, cells, start)
    np.cumsum(start, out=start)
    order = np.empty(start[-1], np.int32)
    sort_into_cells(cells, start[:-1].copy(), order)
    return SortedPositions(coordinates[order], order, start, shift, len(coordinates))


@part(fast=False)
def strip_span(x0: float, y0: float, x1: float, y1: float, skew: float, top: float, bottom: float):  # type: ignore[no-untyped-def]  # numba infers the pair of floats
    """Return the x extent of an ellipse within a horizontal strip; (1, 0) where they are disjoint.

    The ellipse is given by its box and the x offset ``skew`` of its lowest point. The intersection
    is convex: its extent ends at the ellipse's own extreme point if the strip contains it, else on
    the nearer edge of the strip.
    """
    half_x, half_y = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
    if math.isinf(skew) or not (half_x > 0.0 and half_y > 0.0):
        return x0, x1
    center_x, center_y = 0.5 * (x1 + x0), 0.5 * (y1 + y0)
    first = max((top - PIXEL_MARGIN - center_y) / half_y, -1.0)
    last = min((bottom + PIXEL_MARGIN - center_y) / half_y, 1.0)
    if first > last:
        return 1.0, 0.0
    # At height t (in half heights) the ellipse spans skew t +- across sqrt(1 - t^2).
    across = math.sqrt(max(half_x * half_x * (1.0 + SHARE_MARGIN) - skew * skew, 0.0))
    extreme = skew / half_x  # height of the rightmost point; the leftmost is opposite
    t = min(max(extreme, first), last)
    right = skew * t + across * math.sqrt(max(1.0 - t * t, 0.0))
    t = min(max(-extreme, first), last)
    left = skew * t - across * math.sqrt(max(1.0 - t * t, 0.0))
    margin = PIXEL_MARGIN + SHARE_MARGIN * half_x
    return max(center_x + left - margin, x0), min(center_x + right + margin, x1)


@kernel(fast=False)
def scan_areas(
    begin: int, end: int, order: np.ndarray, boxes: np.ndarray, skews: np.ndarray, tiles_x: int,
    tiles_y: int, heads: np.ndarray, intersection_offsets: np.ndarray, gaussian_ids: np.ndarray,
    intersection_slots: np.ndarray,
) -> None:  # fmt: skip
    """Count the intersections of ``order[begin .. end]``; write them if ``gaussian_ids`` has room.

    Counting adds to ``heads (tiles,)`` and writes the number of intersections of Gaussian i to
    ``intersection_offsets[i + 1]``; writing advances ``heads``.
    """
    write = len(gaussian_ids) > 0
    for k in range(begin, end):
        i = order[k]
        x0, y0 = float(boxes[i, 0]), float(boxes[i, 1])
        x1, y1 = float(boxes[i, 2]), float(boxes[i, 3])
        skew = float(skews[i])
        slot = intersection_offsets[i]
        first_row = int(min(max(y0 / TILE, 0.0), tiles_y - 1.0))
        last_row = int(min(max(y1 / TILE, 0.0), tiles_y - 1.0))
        intersections = 0
        for row in range(first_row, last_row + 1):
            left, right = x0, x1
            if first_row < last_row:
                left, right = strip_span(
                    x0, y0, x1, y1, skew, float(row * TILE), float(row * TILE + TILE)
                )
            if left > right:
                continue
            # Clamped before the conversion, which could overflow.
            first = int(min(max(left / TILE, 0.0), tiles_x - 1.0))
            last = int(min(max(right / TILE, 0.0), tiles_x - 1.0))
            for column in range(first, last + 1):
                tile = row * tiles_x + column
                if write:
                    index = heads[tile]
                    gaussian_ids[index] = i
                    intersection_slots[index] = slot + intersections
                heads[tile] += 1
                intersections += 1
        if not write:
            intersection_offsets[i + 1] = intersections


@kernel(fast=False)
def find_cells(
    coordinates: np.ndarray, width: int, height: int, tiles_x: int, tiles_y: int, shift: int,
    cells: np.ndarray, start: np.ndarray,
) -> None:  # fmt: skip
    """Write the cell of each position, or -1; count the positions of cell c in ``start[c + 1]``."""
    mask = (1 << shift) - 1
    cell_px = np.float32(TILE >> shift)
    for p in range(len(coordinates)):
        x, y = coordinates[p, 0], coordinates[p, 1]
        cells[p] = -1
        # Written so that a NaN fails the test.
        if not (x >= 0.0 and y >= 0.0 and x <= width and y <= height):
            continue
        cx = min(int(x / cell_px), (tiles_x << shift) - 1)
        cy = min(int(y / cell_px), (tiles_y << shift) - 1)
        tile = (cy >> shift) * tiles_x + (cx >> shift)
        cell = (tile << (2 * shift)) + ((cy & mask) << shift) + (cx & mask)
        cells[p] = cell
        start[cell + 1] += 1


@kernel(fast=False)
def sort_into_cells(cells: np.ndarray, heads: np.ndarray, order: np.ndarray) -> None:
    """Write the indices of each cell's positions, starting at its ``heads``."""
    for p in range(len(cells)):
        if cells[p] >= 0:
            order[heads[cells[p]]] = p
            heads[cells[p]] += 1
