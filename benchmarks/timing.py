# SPDX-License-Identifier: GPL-3.0-or-later
"""Timing of several parts in turn: smallest times, and how far the others lie above them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence

import numpy as np

Part = tuple[str, Callable[[], object]]
"""Name and function; names are unique within one measurement."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """Times of one part, milliseconds."""

    name: str
    cpu_ms: float
    """Smallest processor time of all threads of the process."""
    wall_ms: float
    """Smallest time on the clock."""
    spread: float
    """Median processor time over the smallest, less 1."""
    repeats: int


def measure(
    parts: Sequence[Part], repeats: int, *, budget_s: float = float("inf"), at_least: int = 2
) -> dict[str, Timing]:
    """Run all parts in turn, after one run that compiles and warms up, and time each.

    Interleaved, so that a slow spell of the machine meets all parts alike, and a part is never
    helped by its own data in the cache.

    Parameters
    ----------
    parts : sequence of (name, function)
    repeats : int
        Rounds that are timed.
    budget_s : float
        No round begins after this many seconds, once ``at_least`` rounds are done.
    at_least : int
    """
    for _, run in parts:
        run()
    cpu_s = np.zeros((repeats, len(parts)))
    wall_s = np.zeros((repeats, len(parts)))
    begun, done = time.perf_counter(), 0
    for turn in range(repeats):
        if turn >= at_least and time.perf_counter() - begun > budget_s:
            break
        for i, (_, run) in enumerate(parts):
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            cpu_s[turn, i] = time.process_time() - cpu
            wall_s[turn, i] = time.perf_counter() - wall
        done = turn + 1
    cpu_s, wall_s = cpu_s[:done], wall_s[:done]
    return {
        name: Timing(
            name,
            1e3 * float(cpu_s[:, i].min()),
            1e3 * float(wall_s[:, i].min()),
            float(np.median(cpu_s[:, i]) / cpu_s[:, i].min() - 1.0),
            done,
        )
        for i, (name, _) in enumerate(parts)
    }
