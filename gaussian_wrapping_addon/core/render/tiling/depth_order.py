# SPDX-License-Identifier: GPL-3.0-or-later
"""Stable sort by distance: a radix sort of key ranges, one range per thread."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...kernels.array_store import ArrayStore
from ...kernels.compiled import kernel
from ...kernels.parallel import run_chunks

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
    keys: np.ndarray,
    bounds: np.ndarray,
    first_key: int,
    end_key: int,
    packed: np.ndarray,
    other: np.ndarray,
    order: np.ndarray,
) -> None:
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
    """Return the indices of keys in increasing order of key, ties by index.

    Parameters
    ----------
    keys : (r,) uint32
    bounds : (m, 2) int64
        The runs of ``keys`` to sort, increasing.
    extent : (int, int)
        Smallest and largest key in these runs.
    threads : int
    store : ArrayStore
        Owns the result, which is valid until the next call with this store.

    Returns
    -------
    (v,) int32
        Indices into ``keys``; the same for any number of threads.
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
                keys,
                bounds,
                int(cuts[part]),
                int(cuts[part + 1]),
                packed[room],
                other[room],
                order[begin:stop],
            )

    run_chunks(sort, np.arange(len(cuts)), threads)
    return order


def radix_order(depths: np.ndarray, visible: np.ndarray, threads: int = 1) -> np.ndarray:
    """Return the indices of the visible rows by increasing distance, ties by index (int32).

    Parameters
    ----------
    depths : (n,) float32
        Distances, >= 0 where visible.
    visible : (n,) bool
    threads : int
    """
    ids = np.nonzero(visible)[0].astype(np.int32)
    # Positive floats are ordered like their bit patterns.
    keys = depths[ids].view(np.uint32)
    extent = (int(keys.min()), int(keys.max())) if len(keys) else (0, 0)
    bounds = np.array([[0, len(keys)]], np.int64)
    return ids[order_by_keys(keys, bounds, extent, threads, ArrayStore())]
