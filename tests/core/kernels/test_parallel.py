# SPDX-License-Identifier: GPL-3.0-or-later
"""Chunks cover all items once; exceptions are propagated."""

from __future__ import annotations

import itertools
import threading

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


def test_calls_within_calls_end() -> None:
    visits = np.zeros((6, 40), np.int64)

    def inner(row: int) -> None:
        def work(begin: int, end: int) -> None:
            visits[row, begin:end] += 1

        run_chunks(work, even_bounds(40, 3), 3)

    def outer(begin: int, end: int) -> None:
        for row in range(begin, end):
            inner(row)

    run_chunks(outer, np.arange(7), 3)
    assert (visits == 1).all()


def test_the_calling_thread_and_others_work() -> None:
    meeting = threading.Barrier(3, timeout=20.0)
    workers = set()

    def work(begin: int, end: int) -> None:
        workers.add(threading.get_ident())
        meeting.wait()  # none returns before three threads are here

    run_chunks(work, np.arange(4), 3)
    assert len(workers) == 3
    assert threading.get_ident() in workers


def test_bounds_balance_costs() -> None:
    costs = np.concatenate([np.full(10, 100.0), np.zeros(50), np.full(10, 100.0)])
    bounds = balanced_bounds(costs, 4)
    assert bounds[0] == 0
    assert bounds[-1] == len(costs)
    shares = [costs[b:e].sum() for b, e in itertools.pairwise(bounds)]
    assert max(shares) <= 600.0


@pytest.mark.parametrize("threads", [2, 3])
def test_the_first_failure_is_raised_after_all_runs(threads: int) -> None:
    called = []

    def work(begin: int, end: int) -> None:
        called.append(begin)
        if begin:
            raise ValueError(f"run at {begin} failed")

    with pytest.raises(ValueError, match="run at 5 failed"):
        run_chunks(work, np.arange(0, 40, 5), threads)
    assert sorted(called) == list(range(0, 35, 5))
