# SPDX-License-Identifier: GPL-3.0-or-later
"""Chunks cover everything once, and failures come out."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gaussian_wrapping_addon.core.parallel import balanced_bounds, even_bounds, run_chunks


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 7, 1000])
def test_every_item_is_visited_once(threads: int, count: int) -> None:
    visits = np.zeros(count, np.int64)

    def work(begin: int, end: int) -> None:
        visits[begin:end] += 1

    run_chunks(work, even_bounds(count, threads), threads)
    assert (visits == 1).all()


def test_bounds_balance_costs() -> None:
    costs = np.concatenate([np.full(10, 100.0), np.zeros(50), np.full(10, 100.0)])
    bounds = balanced_bounds(costs, 4)
    assert bounds[0] == 0
    assert bounds[-1] == len(costs)
    shares = [costs[b:e].sum() for b, e in itertools.pairwise(bounds)]
    assert max(shares) <= 600.0


def test_a_failure_in_a_chunk_is_raised() -> None:
    def work(begin: int, end: int) -> None:
        if begin:
            raise ValueError("chunk failed")

    with pytest.raises(ValueError, match="chunk failed"):
        run_chunks(work, np.array([0, 5, 10]), 2)
