# SPDX-License-Identifier: GPL-3.0-or-later
"""Binary heap over columns, so that a long run can pause, grow the heap and resume (numba).

A heap is a tuple of arrays of equal length: costs float64, ties int64, then any int64 columns. The
entry with the least (cost, tie) comes first; ``counts[HEAP_SIZE]`` entries are in use.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from ...kernels.compiled import part
from .counters import HEAP_SIZE


@part(fast=False)
def _less(heap, a, b):
    costs, ties = heap[0], heap[1]
    return costs[a] < costs[b] or (costs[a] == costs[b] and ties[a] < ties[b])


@part(fast=False)
def _swap(heap, a, b):
    for column in heap[1:]:
        kept = column[a]
        column[a] = column[b]
        column[b] = kept
    cost = heap[0][a]
    heap[0][a] = heap[0][b]
    heap[0][b] = cost


@part(fast=False)
def sift_up_last(heap, counts):
    """Add the entry that was written after the last one."""
    slot = counts[HEAP_SIZE]
    counts[HEAP_SIZE] += 1
    while slot > 0 and _less(heap, slot, (slot - 1) // 2):
        _swap(heap, slot, (slot - 1) // 2)
        slot = (slot - 1) // 2


@part(fast=False)
def _copy(heap, source, target):
    heap[0][target] = heap[0][source]
    for column in heap[1:]:
        column[target] = column[source]


@part(fast=False)
def pop_first(heap, counts):
    """Remove the cheapest entry."""
    last = counts[HEAP_SIZE] - 1
    counts[HEAP_SIZE] = last
    # The last entry fills the hole at the end of the path of smaller children.
    slot = 0
    while True:
        child = 2 * slot + 1
        if child >= last:
            break
        if child + 1 < last and _less(heap, child + 1, child):
            child += 1
        if not _less(heap, child, last):
            break
        _copy(heap, child, slot)
        slot = child
    _copy(heap, last, slot)
