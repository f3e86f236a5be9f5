# SPDX-License-Identifier: GPL-3.0-or-later
"""The heap pops complete entries in order of cost, and equal costs in order of their ties."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.edge_collapse import (
    COUNTERS,
    HEAP_SIZE,
    pop_first,
    sift_up_last,
)

Entry = tuple[float, ...]


def empty(size: int, columns: int) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    heap = (np.zeros(size), *(np.zeros(size, np.int64) for _ in range(columns)))
    return heap, np.zeros(COUNTERS, np.int64)


def push(heap: tuple[np.ndarray, ...], counts: np.ndarray, entry: Entry) -> None:
    for column, value in zip(heap, entry, strict=True):
        column[counts[HEAP_SIZE]] = value
    sift_up_last(heap, counts)


def popped(heap: tuple[np.ndarray, ...], counts: np.ndarray) -> Entry:
    entry = tuple(column[0].item() for column in heap)
    pop_first(heap, counts)
    return entry


@pytest.mark.parametrize("columns", [2, 5])
def test_entries_come_out_sorted_and_whole(columns: int) -> None:
    rng = np.random.default_rng(0)
    heap, counts = empty(400, columns)
    costs = rng.integers(0, 20, 300) / 7.0  # many equal ones
    entries = [(c, i, *(10 * i + k for k in range(columns - 1))) for i, c in enumerate(costs)]
    for index in rng.permutation(300):
        push(heap, counts, entries[index])
    assert [popped(heap, counts) for _ in range(300)] == sorted(entries)
    assert counts[HEAP_SIZE] == 0


def test_pushing_between_pops_keeps_the_order() -> None:
    rng = np.random.default_rng(1)
    heap, counts = empty(400, 2)
    kept: list[Entry] = []
    for number in range(300):
        entry = (float(rng.random()), number, 7 * number)
        push(heap, counts, entry)
        kept.append(entry)
        if number % 3 == 2:
            assert popped(heap, counts) == min(kept)
            kept.remove(min(kept))
    assert counts[HEAP_SIZE] == len(kept) == 200
