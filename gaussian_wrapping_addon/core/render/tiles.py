# SPDX-License-Identifier: GPL-3.0-or-later
"""Tile lists in blending order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import limits
from ..compiled import kernel
from ..errors import ResourceError, UsageError
from ..parallel import ArrayStore, balanced_bounds, even_bounds, run_chunks
from .projection import ScreenGaussians
from .tile_kernels import (
    ID,
    RECORD_VALUES,
    assign_slots,
    count_band,
    range_pixels,
    rank_records,
    scatter_tiles,
    span_tiles,
)

# -- Stable sort by distance: a radix sort of key ranges, one range per thread --------------------


_DIGIT_BITS = 10
_BUCKETS = 1 << _DIGIT_BITS
_MAX_DIGITS = 4
# Below this, a second thread costs more than it saves.
_KEYS_PER_PART = 8192
_COARSE_BITS = 10
_INDEX_MASK = np.uint64(0xFFFFFFFF)


@kernel(fast=False)
def _coarse_histogram(
    keys: np.ndarray, bounds: np.ndarray, lowest: int, shift: int, histogram: np.ndarray
) -> None:
    """Histogram the keys by their highest bits."""
    histogram[:] = 0
    for run in range(len(bounds)):
        for k in range(bounds[run, 0], bounds[run, 1]):
            histogram[(np.int64(keys[k]) - lowest) >> shift] += 1


@kernel(fast=False)
def _sort_part(
    keys: np.ndarray, bounds: np.ndarray, first_key: int, end_key: int, packed: np.ndarray,
    other: np.ndarray, order: np.ndarray,
) -> None:  # fmt: skip
    """Write the indices of the keys in ``first_key .. end_key`` to ``order``, sorted.

    ``order`` has exactly their number of elements, ``packed`` and ``other`` one more.
    """
    begin, end = 0, np.uint64(0)
    largest = np.int64(0)
    for run in range(len(bounds)):
        for k in range(bounds[run, 0], bounds[run, 1]):
            # Branch-free: every key is written, and overwritten by the next unless it belongs here.
            key = np.int64(keys[k]) - first_key
            belongs = (key >= 0) & (key < end_key - first_key)
            packed[end] = (np.uint64(key) << np.uint64(32)) | np.uint64(k)
            largest = max(largest, key if belongs else np.int64(0))
            end += np.uint64(belongs)
    bits = 0
    while largest >> bits:
        bits += 1
    digits = (bits + _DIGIT_BITS - 1) // _DIGIT_BITS
    width = np.uint64((bits + digits - 1) // digits) if digits else np.uint64(0)
    mask = (np.uint64(1) << width) - np.uint64(1)
    heads = np.zeros((_MAX_DIGITS, _BUCKETS), np.int64)
    for k in range(begin, end):
        key = packed[k] >> np.uint64(32)
        for digit in range(digits):
            heads[digit, np.int64((key >> (width * np.uint64(digit))) & mask)] += 1
    for digit in range(digits):
        total: Any = begin
        for value in range(np.int64(mask) + 1):
            number = heads[digit, value]
            heads[digit, value] = total
            total += number
        shift = np.uint64(32) + width * np.uint64(digit)
        for k in range(begin, end):
            bucket = np.int64((packed[k] >> shift) & mask)
            index = heads[digit, bucket]
            heads[digit, bucket] = index + 1
            other[index] = packed[k]
        packed, other = other, packed
    for k in range(begin, end):
        order[k] = np.int32(packed[k] & _INDEX_MASK)


def order_by_keys(
    keys: np.ndarray, bounds: np.ndarray, extent: tuple[int, int], threads: int, store: ArrayStore
) -> np.ndarray:
    """Return the (v,) int32 indices of keys in increasing order of key, ties by index.

    ``bounds (m, 2)`` are the runs of ``keys (r,) uint32`` to sort, increasing; ``extent`` is the
    smallest and largest key in them. The result is the same for any number of threads, and belongs
    to ``store`` until the next call with it.
    """
    count = int((bounds[:, 1] - bounds[:, 0]).sum())
    order = store.take("order", count, np.int32)
    lowest, highest = extent
    parts = max(1, min(threads, count // _KEYS_PER_PART))
    packed = store.take("packed", count + parts, np.uint64)
    other = store.take("packed other", count + parts, np.uint64)
    cuts, begins = np.array([lowest, highest + 1]), np.array([0, count])
    if parts > 1:
        shift = max(0, (highest - lowest).bit_length() - _COARSE_BITS)
        histogram = store.take("key histogram", 1 << _COARSE_BITS, np.int64)
        _coarse_histogram(keys, bounds, lowest, shift, histogram)
        below = np.concatenate([[0], np.cumsum(histogram)])
        bins = np.unique(np.searchsorted(below, np.linspace(0, count, parts + 1)))
        cuts, begins = lowest + (bins << shift), below[bins]

    def sort(first: int, end: int) -> None:
        for part in range(first, end):
            begin, stop = int(begins[part]), int(begins[part + 1])
            room = slice(begin + part, stop + part + 1)
            _sort_part(
                keys, bounds, int(cuts[part]), int(cuts[part + 1]), packed[room], other[room],
                order[begin:stop],
            )  # fmt: skip

    run_chunks(sort, np.arange(len(cuts)), threads)
    return order


def radix_order(depths: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return the indices of the visible rows by increasing distance >= 0, ties by index (int32)."""
    ids = np.nonzero(visible)[0].astype(np.int32)
    # Positive floats are ordered like their bit patterns.
    keys = depths[ids].view(np.uint32)
    extent = (int(keys.min()), int(keys.max())) if len(keys) else (0, 0)
    bounds = np.array([[0, len(keys)]], np.int64)
    return ids[order_by_keys(keys, bounds, extent, 1, ArrayStore())]


# -- Tile lists: the Gaussians that reach each tile of 16 x 16 pixels, in blending order ----------


_MAX_INTERSECTIONS = 2**31 - 1
_MAX_TILES_ACROSS = 2**16 - 1
_CHUNKS_PER_THREAD = 2


@dataclass(frozen=True)
class TileLists:
    """For each tile, the Gaussians whose ellipse ``alpha >= 1/255`` reaches it, nearest first.

    Tiles are numbered row by row. An *intersection* is one (tile, Gaussian); *slots* number the
    intersections so that those of one Gaussian are contiguous: their gradients are written there.
    The lists may be those of a band of tiles; all other lists are empty then.
    """

    start: np.ndarray
    """(tiles + 1,) int64: tile t has the intersections ``start[t] .. start[t + 1]``."""
    gaussian_ids: np.ndarray
    """(intersections,) int32, by increasing distance within a tile, ties by index."""
    intersection_slots: np.ndarray
    """(intersections,) int32: slot of each intersection."""
    intersection_offsets: np.ndarray
    """(n + 1,) int64: the slots of Gaussian i are ``[offsets[i], offsets[i + 1])``."""
    pixel_ranges: np.ndarray
    """(n, 4) int32: first and last row, first and last column of the pixels of the image whose
    centres lie in the box; empty (first > last) where not visible."""
    tiles_x: int
    tiles_y: int


class TileBinning:
    """The tiles that each Gaussian of a view reaches; yields the lists of any band of tiles.

    ``ids (v,) int32`` are the Gaussians that reach a tile, increasing;
    ``tile_counts (tiles,) int64`` the numbers of Gaussians that reach each tile. Others as in
    :class:`TileLists`.
    """

    def __init__(
        self, screen: ScreenGaussians, width: int, height: int, threads: int, store: ArrayStore
    ) -> None:
        """Find tiles and depth order; the arrays are valid until the next binning with ``store``.

        Raises
        ------
        UsageError
            If a side of the image has 2^16 tiles or more.
        ResourceError
            If the Gaussians reach more than 2^31 - 1 rows of tiles.
        """
        tile = limits.TILE_PX
        self.tiles_x, self.tiles_y = -(-width // tile), -(-height // tile)
        if max(self.tiles_x, self.tiles_y) > _MAX_TILES_ACROSS:
            raise UsageError(
                f"An image of {width} x {height} pixels is too large.", "Render a smaller image."
            )
        self.threads, self._store = threads, store
        count = len(screen)
        self._count = count
        self._gaussians = _bounds(count, threads)  # runs of Gaussians, one a chunk
        chunks = len(self._gaussians) - 1
        self.pixel_ranges = store.take("pixel ranges", (count, 4), np.int32)
        found = np.zeros((chunks + 1, 2), np.int64)  # visible, tile rows they reach

        def ranges(first: int, end: int) -> None:
            for chunk in range(first, end):
                begin, stop = self._gaussians[chunk], self._gaussians[chunk + 1]
                found[chunk + 1] = range_pixels(
                    begin, stop, screen.boxes, screen.visible, width, height, self.pixel_ranges
                )

        run_chunks(ranges, np.arange(chunks + 1), threads)
        starts = np.cumsum(found, axis=0)
        if starts[-1, 1] > _MAX_INTERSECTIONS:
            raise ResourceError(
                f"The Gaussians reach {starts[-1, 1]} rows of tiles.", "Render a smaller image."
            )
        self._spans = store.take("spans", (int(starts[-1, 1]), 2), np.uint16)
        self._records = store.take("records", (int(starts[-1, 0]), RECORD_VALUES), np.int32)
        keys = store.take("keys", int(starts[-1, 0]), np.uint32)
        changes = store.take("changes", (chunks, self.tiles_y, self.tiles_x + 1), np.int32)
        results = np.zeros((chunks, 4), np.int64)  # end record, count, lowest and highest key

        def spans(first: int, end: int) -> None:
            for chunk in range(first, end):
                results[chunk] = span_tiles(
                    self._gaussians[chunk], self._gaussians[chunk + 1], starts[chunk, 0],
                    starts[chunk, 1], screen.boxes, screen.skews, screen.visible, screen.depths,
                    self.pixel_ranges, self._spans, self._records, keys, changes[chunk],
                )  # fmt: skip

        run_chunks(spans, np.arange(chunks + 1), threads)
        # Gaussians that turn out to reach no tile leave gaps at the ends of the runs.
        self._runs = np.stack([starts[:-1, 0], results[:, 0]], 1)  # (chunks, 2) runs of records
        # Until slots replace them, the records hold the intersection counts of the whole image.
        self._image_intersections: np.ndarray | None = results[:, 1]
        seen = int((self._runs[:, 1] - self._runs[:, 0]).sum())
        self.ids = store.take("ids", seen, np.int32)
        at = 0
        for begin, end in self._runs.tolist():
            self.ids[at : at + end - begin] = self._records[begin:end, ID]
            at += end - begin
        per_tile = changes.sum(0, dtype=np.int64).cumsum(1)  # (tiles_y, tiles_x + 1)
        self.tile_counts = np.ascontiguousarray(per_tile[:, :-1]).reshape(-1)
        extent = (0, 0)
        if seen:
            extent = int(results[:, 2].min()), int(results[:, 3].max())
        self._order = order_by_keys(keys, self._runs, extent, threads, store)

    def bands(self, max_intersections: int) -> list[tuple[int, int]]:
        """Split the tiles into runs of at most ``max_intersections``, or of a single tile.

        Returns (first, end) of at least one band, even if nothing is visible.
        """
        below = np.concatenate([[0], np.cumsum(self.tile_counts)])
        tiles = len(self.tile_counts)
        bands, first = [], 0
        while first < tiles:
            fitting = (
                int(np.searchsorted(below, below[first] + max_intersections, side="right")) - 1
            )
            end = min(max(fitting, first + 1), tiles)
            bands.append((first, end))
            first = end
        return bands

    def lists(self, first: int, end: int, max_intersections: int | None = None) -> TileLists:
        """Return the lists of the tiles ``first .. end``, overwriting those of the last call.

        Memory for ``max_intersections`` is reserved ahead of need. Raises ResourceError if the
        lists would hold more than 2^31 - 1 intersections.
        """
        store, threads = self._store, self.threads
        tiles = len(self.tile_counts)
        start = store.take("start", tiles + 1, np.int64)
        start[: first + 1] = 0
        np.cumsum(self.tile_counts[first:end], out=start[first + 1 : end + 1])
        start[end:] = intersections = int(start[end])
        if intersections > _MAX_INTERSECTIONS:
            raise ResourceError(
                f"{intersections} tile intersections do not fit.",
                "Render a smaller image or with a smaller budget.",
            )
        intersection_offsets = self._offsets(first, end)
        heads = store.take("heads", tiles, np.int64)
        heads[:] = start[:-1]
        gaussian_ids = store.take("gaussian ids", intersections, np.int32, max_intersections)
        intersection_slots = store.take(
            "intersection slots", intersections, np.int32, max_intersections
        )
        ranked = store.take("ranked", (len(self._order), RECORD_VALUES), np.int32)

        def rank(begin: int, stop: int) -> None:
            rank_records(begin, stop, self._order, self._records, ranked)

        run_chunks(rank, _bounds(len(ranked), threads), threads)

        def scatter(first_tile: int, end_tile: int) -> None:
            scatter_tiles(
                first_tile, end_tile, first, end, self.tiles_x, ranked, self._spans, heads,
                gaussian_ids, intersection_slots,
            )  # fmt: skip

        # Each thread passes over the whole order and keeps what falls into its tiles.
        bounds = first + balanced_bounds(self.tile_counts[first:end], threads)
        run_chunks(scatter, bounds, threads)
        return TileLists(
            start, gaussian_ids, intersection_slots, intersection_offsets, self.pixel_ranges,
            self.tiles_x, self.tiles_y,
        )  # fmt: skip

    def _offsets(self, first: int, end: int) -> np.ndarray:
        """Number the slots of a band; return (n + 1,) offsets."""
        chunks, threads = len(self._runs), self.threads
        offsets = self._store.take("intersection offsets", self._count + 1, np.int64)
        totals = np.zeros(chunks + 1, np.int64)

        def count(first_chunk: int, end_chunk: int) -> None:
            for chunk in range(first_chunk, end_chunk):
                begin, stop = self._runs[chunk]
                totals[chunk + 1] = count_band(
                    begin, stop, first, end, self.tiles_x, self._spans, self._records
                )

        if self._image_intersections is not None and (first, end) == (0, len(self.tile_counts)):
            totals[1:] = self._image_intersections
        else:
            run_chunks(count, np.arange(chunks + 1), threads)
        self._image_intersections = None
        slots = np.cumsum(totals)

        def assign(first_chunk: int, end_chunk: int) -> None:
            for chunk in range(first_chunk, end_chunk):
                begin, stop = self._runs[chunk]
                begin_gaussian, end_gaussian = self._gaussians[chunk : chunk + 2]
                assign_slots(
                    begin, stop, begin_gaussian, end_gaussian, slots[chunk], self._records, offsets
                )

        run_chunks(assign, np.arange(chunks + 1), threads)
        offsets[self._count] = slots[-1]
        return offsets


def _bounds(count: int, threads: int) -> np.ndarray:
    """Split the Gaussians: one run for a single thread, else a few per thread."""
    return even_bounds(count, threads, _CHUNKS_PER_THREAD if threads > 1 else 1)
