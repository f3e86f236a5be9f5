# SPDX-License-Identifier: GPL-3.0-or-later
"""Threads of our own for compiled kernels that release the GIL.

numba's ``parallel=True`` is not used: with its default layer, two Python threads that launch at
once can abort the process, which inside Blender would lose the user's scene.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

CHUNKS_PER_THREAD = 16


def default_threads() -> int:
    """Return the number of cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return max(1, os.cpu_count() or 1)


@functools.lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="gwrap")


def balanced_bounds(costs: np.ndarray, chunks: int) -> np.ndarray:
    """Split items into runs of about equal cost.

    Parameters
    ----------
    costs : (n,) array
        Cost of each item, >= 0.
    chunks : int
        Number of runs wanted.

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

    An exception of any call is raised here, after the others have ended.
    """
    begins, ends = bounds[:-1].tolist(), bounds[1:].tolist()
    if threads <= 1 or len(begins) <= 1:
        for begin, end in zip(begins, ends, strict=True):
            function(begin, end)
        return
    futures = [_pool(threads).submit(function, b, e) for b, e in zip(begins, ends, strict=True)]
    failures = [f.exception() for f in futures]
    for failure in failures:
        if failure is not None:
            raise failure
