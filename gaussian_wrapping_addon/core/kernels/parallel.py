# SPDX-License-Identifier: GPL-3.0-or-later
"""Thread pool for compiled kernels that release the GIL.

numba's ``parallel=True`` is not used: with its default threading layer, two Python threads that
launch at once can abort the process, which inside Blender would lose the user's scene.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..machine import processor_count

CHUNKS_PER_THREAD = 16


def default_threads() -> int:
    """Return the number of processors available to this process."""
    return processor_count()


@functools.lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="gwrap")


def balanced_bounds(costs: np.ndarray, chunks: int) -> np.ndarray:
    """Split items into runs of about equal cost.

    Parameters
    ----------
    costs : (n,) array
        Cost of each item, >= 0.
    chunks : int
        Desired number of runs.

    Returns
    -------
    (m,) int64
        Increasing bounds from 0 to n; run i is ``[bounds[i], bounds[i + 1])``.
    """
    total = np.concatenate([[0.0], np.cumsum(np.asarray(costs, dtype=np.float64))])
    cuts = np.searchsorted(total, np.linspace(0.0, total[-1], chunks + 1))
    cuts[0], cuts[-1] = 0, len(costs)
    return np.unique(cuts.clip(0, len(costs))).astype(np.int64)


def even_bounds(count: int, threads: int, chunks_per_thread: int = 4) -> np.ndarray:
    """Split ``count`` items into runs of equal length (int64 bounds from 0 to ``count``)."""
    chunks = max(1, min(count, threads * chunks_per_thread))
    return np.unique(np.linspace(0, count, chunks + 1).astype(np.int64))


def run_chunks(function: Callable[[int, int], object], bounds: np.ndarray, threads: int) -> None:
    """Call ``function(begin, end)`` for each run of ``bounds`` on ``threads`` threads.

    The calling thread is one of them; each of the others is one submitted task that takes run after
    run. An exception is raised here: with one thread at once, with several that of the first
    failing run, after all others.
    """
    begins, ends = bounds[:-1].tolist(), bounds[1:].tolist()
    if threads <= 1 or len(begins) <= 1:
        for begin, end in zip(begins, ends, strict=True):
            function(begin, end)
        return
    waiting = deque(enumerate(zip(begins, ends, strict=True)))
    failures: list[tuple[int, BaseException]] = []

    def work() -> None:
        while True:
            try:
                run, (begin, end) = waiting.popleft()
            except IndexError:
                return
            try:
                function(begin, end)
            except BaseException as failure:
                failures.append((run, failure))

    pool, helpers = _pool(threads), min(threads, len(begins)) - 1
    futures = [pool.submit(work) for _ in range(helpers)]
    work()
    for future in futures:
        # A task that has not started has nothing left to do; waiting for it could deadlock if all
        # of the pool's threads are callers themselves.
        if not future.cancel():
            future.result()
    if failures:
        raise min(failures, key=lambda failed: failed[0])[1]
