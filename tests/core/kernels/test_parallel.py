# SPDX-License-Identifier: GPL-3.0-or-later
"""Chunks, threads and memory of the kernels."""

from __future__ import annotations

import itertools
import sys
import threading

import numpy as np
import pytest

from gaussian_wrapping_addon.core import parallel
from gaussian_wrapping_addon.core.parallel import (
    balanced_bounds,
    empty_array,
    even_bounds,
    run_chunks,
)
from tests.core.kernels import kernel_stages


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


@pytest.mark.parametrize("stage", kernel_stages.STAGES)
def test_one_thread_starts_no_pool(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a part of the work chose its number of threads itself")

    monkeypatch.setattr(parallel, "_pool", refuse)
    patched = 0
    for name, module in list(sys.modules.items()):
        if name.startswith(kernel_stages.PACKAGE) and hasattr(module, "default_threads"):
            monkeypatch.setattr(module, "default_threads", refuse)
            patched += 1
    assert patched > 8
    assert kernel_stages.STAGES[stage]()


def test_the_pool_is_what_several_threads_start(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    usual = parallel._pool

    def count(threads: int) -> object:
        asked.append(threads)
        return usual(threads)

    monkeypatch.setattr(parallel, "_pool", count)
    monkeypatch.setattr(kernel_stages, "THREADS", 2)
    kernel_stages.STAGES["fields"]()
    assert set(asked) == {2}


PAGE = 2**21


@pytest.mark.parametrize("dtype", [np.float32, np.bool_, np.int64])
@pytest.mark.parametrize("size", [PAGE // 2, PAGE, PAGE + 8, 5 * PAGE - 8])
def test_large_arrays_begin_at_a_page(dtype: type, size: int) -> None:
    count = size // np.dtype(dtype).itemsize
    array = empty_array(count, dtype)
    assert array.shape == (count,)
    assert array.dtype == dtype
    assert array.flags.c_contiguous
    assert array.flags.writeable
    assert array.ctypes.data % PAGE == 0
    array[:] = 1
    assert array.all()


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_small_arrays(count: int) -> None:
    array = empty_array(count, np.float32)
    assert array.shape == (count,)
    assert array.dtype == np.float32
