# SPDX-License-Identifier: GPL-3.0-or-later
"""Threads, and memory that is used again from call to call."""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import DTypeLike

from .machine import processor_count

# -- Thread pool for compiled kernels that release the GIL ----------------------------------------
#
# numba's ``parallel=True`` is not used: with its default threading layer, two Python threads that
# launch at once can abort the process, which inside Blender would lose the user's scene.


CHUNKS_PER_THREAD = 16


def default_threads() -> int:
    """Return the number of processors available to this process."""
    return processor_count()


@functools.lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="gwrap")


def balanced_bounds(costs: np.ndarray, chunks: int) -> np.ndarray:
    """Split items of costs (n,) >= 0 into about so many runs of about equal cost.

    Returns increasing bounds (m,) int64 from 0 to n; run i is ``[bounds[i], bounds[i + 1])``.
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


def run_rows(
    function: Callable[..., object], count: int, threads: int, *given: object, chunks: int = 4
) -> None:
    """Call ``function(begin, end, *given)`` for even runs of ``count`` rows; 0 threads: all.

    ``chunks`` are the runs for each thread.
    """
    threads = threads or default_threads()
    bounds = even_bounds(count, threads, chunks)
    run_chunks(lambda begin, end: function(begin, end, *given), bounds, threads)


# -- Memory for large arrays, aligned so that the system can use huge pages -----------------------


_PAGE_BYTES = 1 << 21  # a huge page of x86, and of ARM with 4 kB pages
_LARGE_BYTES = 1 << 19
"""Smallest array to align; for smaller ones a huge page would be mostly empty."""
_ADVISED_BYTES = 1 << 22  # allocation size from which numpy requests huge pages from Linux


def empty_array(count: int, dtype: DTypeLike) -> np.ndarray:
    """Return an uninitialised one-dimensional array, a large one on pages of 2 MiB.

    Raster kernels access rows of Gaussians in random order; with pages of 4 kB, blending takes a
    third longer. Memory beyond the array is reserved but not used, except for the last page.
    """
    kind = np.dtype(dtype)
    size = count * kind.itemsize
    if size < _LARGE_BYTES:
        return np.empty(count, kind)
    # One page for alignment, and whole pages up to the end.
    reserved = -(-size // _PAGE_BYTES) * _PAGE_BYTES + _PAGE_BYTES
    memory = np.empty(max(reserved, _ADVISED_BYTES), np.uint8)
    first = -memory.ctypes.data % _PAGE_BYTES
    return memory[first : first + size].view(kind)


# -- Named arrays whose memory is reused between calls --------------------------------------------


# A buffer that has to grow is over-allocated by this share, so that slowly growing sets of
# Gaussians do not allocate in every iteration.
_GROWTH = 0.25


class ArrayStore:
    """Arrays by name, reused as long as they are large enough; not thread-safe.

    An array is valid until its name is taken again. Fresh memory from the system costs a page fault
    every 4 kB, which for the arrays of a rendering adds up to milliseconds.
    """

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}

    def take(
        self, name: str, shape: tuple[int, ...] | int, dtype: DTypeLike, limit: int | None = None
    ) -> np.ndarray:
        """Return an uninitialised C-contiguous array, as :func:`numpy.empty` does.

        A name has one dtype and one shape after the first axis. At most ``limit`` rows are reserved
        ahead of need.
        """
        shape = (shape,) if isinstance(shape, int) else shape
        kept = self._kept.get(name)
        size = math.prod(shape)
        if kept is None or len(kept) < size or kept.dtype != np.dtype(dtype):
            # Free the old memory before allocating the new.
            self._kept.pop(name, None)
            kept = None
            reserved = shape[0] + int(_GROWTH * shape[0])
            if limit is not None:
                reserved = max(shape[0], min(reserved, limit))
            kept = self._kept[name] = empty_array(reserved * math.prod(shape[1:]), dtype)
        return kept[:size].reshape(shape)

    def zeros(self, name: str, shape: tuple[int, ...] | int, dtype: DTypeLike) -> np.ndarray:
        """Return an array like :meth:`take`, filled with 0."""
        array = self.take(name, shape, dtype)
        array.fill(0)
        return array

    def names(self) -> list[str]:
        """Return the names of the stored arrays."""
        return list(self._kept)

    def nbytes(self, *names: str) -> int:
        """Return the total size of these arrays; names never taken count 0."""
        return sum(self._kept[name].nbytes for name in names if name in self._kept)
