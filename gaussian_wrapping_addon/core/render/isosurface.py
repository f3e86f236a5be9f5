# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled solver of the 0.5-isosurface depth of a run of pixels, from lists of contributors.

Along a pixel's ray ``T(t) = prod_i (1 - min(0.99, alpha_i exp(-s_i max(t_i - t, 0)^2 / 2)))`` falls
with t; the depth is where it crosses 0.5 (method.md 2.4). Each pixel keeps a bracket, starts where
the Gaussian at which the blending crosses 0.5 would cross it alone, and takes Newton steps on
log T; a step that leaves the bracket, or too many steps, is replaced by bisection.

While a tile is blended, :func:`append_run` gathers each pixel's contributors without gaps, so that
one vector operation serves a Gaussian of each of 8 or 16 neighbouring pixels, not the same one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..compiled import inline, kernel
from .raster_math import ALPHA_MAX, HALF, ISO_LEVEL, ONE, PLANE, TILE, TWO, ZERO, exp_wide
from .vector_runs import copy_run, lowest_bit, max_run

LIST_VALUES = 3
"""Values per contributor: alpha before the cap, z-depth of the peak, sharpness (1 / sigma^2)."""

# Planes of the tile's scratch array that blending and solver share.
TRANSMITTANCE = 0
ALPHA, PEAK, SHARPNESS = PLANE, 2 * PLANE, 3 * PLANE
SHARPEST = 4 * PLANE
DEPTH, SLOPE = 5 * PLANE, 6 * PLANE
_RUNS = 7 * PLANE
# One run each, for the pixels being solved. The first three hold one slot of the lists.
_ALPHA, _PEAK, _SHARPNESS = _RUNS, _RUNS + TILE, _RUNS + 2 * TILE
_T, _LOW, _HIGH = _RUNS + 3 * TILE, _RUNS + 4 * TILE, _RUNS + 5 * TILE
_PRODUCT, _DERIVATIVE = _RUNS + 6 * TILE, _RUNS + 7 * TILE
_FINAL, _SHARPEST, _SLOPE = _RUNS + 8 * TILE, _RUNS + 9 * TILE, _RUNS + 10 * TILE
_CROSS_BEFORE, _CROSS_SLOT, _GUESS = _RUNS + 11 * TILE, _RUNS + 12 * TILE, _RUNS + 13 * TILE
_OPEN = _RUNS + 14 * TILE
"""1 where the pixel has not converged, else 0."""
_TEST = _RUNS + 15 * TILE
_LAST_T, _LAST_SLOPE = _RUNS + 16 * TILE, _RUNS + 17 * TILE
SOLVER_END = _RUNS + 18 * TILE

_NEWTON_STEPS = 8
"""From here on every second step is a bisection, which bounds the number of steps."""
_MAX_STEPS = 80
# Converged: a Newton step below this share of the thinnest Gaussian's sigma along the ray, where
# the slope can be extrapolated from the last step or need not be ...
_STEP_SIGMAS, _STEP_SIGMAS_ALONE = np.float32(2e-4), np.float32(1e-5)
_NEAR_SIGMAS = np.float32(0.1)
_NO_LAST_T = np.float32(-1e30)
"""So far before every depth that it is never near, however wide the Gaussians are."""
# ... or below the rounding of the depth itself ...
_STEP_SHARE = np.float32(2.5e-7)
# ... or a transmittance equal to 0.5 within its own rounding.
_LEVEL_MARGIN = np.float32(3e-7)
SLOPE_FLOOR = np.float32(1e-3)
"""Floor of -d(log T)/dt in shares of the pixel's largest 1/sigma along the ray (method.md 2.5)."""
_NEWTON_FLOOR = np.float32(1e-6)
# exp(-x) is below 3e-7 beyond this x = s d^2.
_NEGLIGIBLE = np.float32(30.0)
_THIRD, _FIFTH = np.float32(1.0 / 3.0), np.float32(0.2)
_TINY = np.float32(1e-30)


@inline
def append_run(
    lanes: Any, m: Any, b: Any, pixels: Any, lists: Any, counts: Any, at: Any
) -> None:  # fmt: skip
    """Append one Gaussian to the lists of the pixels of a run whose bits are set in ``pixels``.

    ``at`` is where the lists of the run begin.
    """
    place = np.uint64(at)
    while pixels != np.uint64(0):
        x = lowest_bit(pixels)
        pixels &= pixels - np.uint64(1)
        pixel = np.uint64(b) + x
        number = counts[pixel]
        slot = place + np.uint64(number) * np.uint64(LIST_VALUES * lanes) + x
        lists[slot] = m[np.uint64(ALPHA) + pixel]
        lists[slot + np.uint64(lanes)] = m[np.uint64(PEAK) + pixel]
        lists[slot + np.uint64(2 * lanes)] = m[np.uint64(SHARPNESS) + pixel]
        counts[pixel] = number + np.uint32(1)


@inline
def _load_slot(lanes: Any, m: Any, lists: Any, at: Any, slot: Any) -> None:
    """Bring one slot of the lists, a contributor of each pixel, to its fixed place."""
    place = at + slot * (LIST_VALUES * lanes)
    copy_run(lanes, m, _ALPHA, lists, place)
    copy_run(lanes, m, _PEAK, lists, place + lanes)
    copy_run(lanes, m, _SHARPNESS, lists, place + 2 * lanes)


@inline
def _cross_slot(lanes: Any, m: Any, number: Any) -> None:
    """Blend one slot; note where 0.5 is crossed and the deepest peak so far."""
    for x in range(lanes):
        alpha = min(m[_ALPHA + x], ALPHA_MAX)
        before = m[_PRODUCT + x]
        after = before - alpha * before
        m[_PRODUCT + x] = after
        above = before > ISO_LEVEL
        reached = m[_PEAK + x] if above & (alpha > ZERO) else ZERO
        m[_HIGH + x] = max(m[_HIGH + x], reached)
        # Each pixel crosses once, so sums hold what was there.
        crosses = above & (after <= ISO_LEVEL)
        m[_CROSS_BEFORE + x] += before if crosses else ZERO
        m[_CROSS_SLOT + x] += number if crosses else ZERO


@inline
def _start(lanes: Any, m: Any, limit: Any, nearest: Any) -> None:
    """Set brackets and first guesses; open the pixels that have an isosurface.

    The Gaussians at the crossings are in the place of a loaded slot.
    """
    for x in range(lanes):
        final = m[_FINAL + x]
        crossed = (m[_CROSS_BEFORE + x] > ZERO) & (final <= limit) & (final < ISO_LEVEL)
        # Alone, the Gaussian at the crossing lets 0.5 through where exp(-s d^2 / 2) = ratio;
        # the logarithm is the series of artanh.
        light = min(m[_ALPHA + x], ALPHA_MAX) * m[_CROSS_BEFORE + x]
        ratio = (m[_CROSS_BEFORE + x] - ISO_LEVEL) / max(light, _TINY)
        ratio = min(max(ratio, ZERO), ONE)
        y = (ratio - ONE) / (ratio + ONE)
        square = y * y
        log_ratio = TWO * y * (ONE + square * (_THIRD + square * _FIFTH))
        sharpness = max(m[_SHARPNESS + x], _TINY)
        ahead = math.sqrt(max(-TWO * log_ratio / sharpness, ZERO))
        high = m[_HIGH + x]
        guess = m[_PEAK + x] - ahead
        guess = guess if guess > nearest else HALF * (nearest + high)
        m[_LOW + x] = nearest
        m[_T + x] = guess if crossed else ZERO
        m[_OPEN + x] = ONE if crossed else ZERO


@inline
def _clear(lanes: Any, m: Any) -> None:
    """Begin a pass: product 1, derivative 0."""
    for x in range(lanes):
        m[_PRODUCT + x] = ONE
        m[_DERIVATIVE + x] = ZERO


@inline
def _multiply_slot(lanes: Any, m: Any) -> None:
    """Multiply one slot's factors, and their derivative, into T at the current depths."""
    for x in range(lanes):
        ahead = max(m[_PEAK + x] - m[_T + x], ZERO)
        pull = m[_SHARPNESS + x] * ahead
        density = min(m[_ALPHA + x] * exp_wide(HALF * pull * ahead), ALPHA_MAX)
        keep = ONE - density
        product = m[_PRODUCT + x]
        m[_DERIVATIVE + x] = m[_DERIVATIVE + x] * keep - product * density * pull
        m[_PRODUCT + x] = product * keep


@inline
def _matters(lanes: Any, m: Any) -> Any:
    """Return whether the loaded slot can change T before the end of any open bracket."""
    for x in range(lanes):
        behind = max(m[_PEAK + x] - m[_HIGH + x], ZERO)
        seen = (m[_SHARPNESS + x] * behind * behind < _NEGLIGIBLE) & (m[_ALPHA + x] > ZERO)
        m[_TEST + x] = m[_OPEN + x] if seen else ZERO
    return max_run(lanes, m, _TEST) > ZERO


@inline
def _step(lanes: Any, m: Any, bisect: Any) -> None:
    """Move the open pixels and close those that have converged."""
    for x in range(lanes):
        t = m[_T + x]
        product = max(m[_PRODUCT + x], _TINY)
        y = (TWO * product - ONE) / (TWO * product + ONE)
        square = y * y
        excess = TWO * y * (ONE + square * (_THIRD + square * _FIFTH))  # log(T / 0.5)
        sharpest = math.sqrt(max(m[_SHARPEST + x], _TINY))
        slope = -m[_DERIVATIVE + x] / product
        step = excess / max(slope, _NEWTON_FLOOR * sharpest)
        above = excess > ZERO
        is_open = m[_OPEN + x] > ZERO
        low = m[_LOW + x]
        high = m[_HIGH + x]
        low = t if above else low
        high = high if above else t
        moved = t + step
        newton = (moved > low) & (moved < high) & (bisect == 0)
        size = abs(step)
        between = t - m[_LAST_T + x]
        apart = abs(between) * sharpest
        smooth = (apart < _NEAR_SIGMAS) & (apart > _STEP_SIGMAS_ALONE)
        bend = (slope - m[_LAST_SLOPE + x]) / (between if smooth else ONE)
        bend = bend if smooth else ZERO
        share = _STEP_SIGMAS if smooth else _STEP_SIGMAS_ALONE
        # Rounding may put a step this small on the bracket's end, hence no test for inside.
        done = size <= max(share / sharpest, _STEP_SHARE * t)
        done = done | (abs(excess) <= _LEVEL_MARGIN) | (high - low <= _STEP_SHARE * high)
        settled = min(max(moved, low), high)
        middle = HALF * (low + high)
        moved = moved if newton else middle
        moved = settled if done else moved
        m[_LOW + x] = low
        m[_HIGH + x] = high
        m[_T + x] = moved if is_open else t
        old = m[_SLOPE + x]
        settled_slope = slope + bend * (settled - t)
        floored = max(settled_slope, SLOPE_FLOOR * sharpest)
        m[_LAST_T + x] = t
        m[_LAST_SLOPE + x] = slope
        m[_SLOPE + x] = floored if is_open else old
        stays = is_open & (~done)
        m[_OPEN + x] = ONE if stays else ZERO


@inline
def _solve(
    lanes: Any, m: Any, b: Any, lists: Any, counts: Any, at: Any, nearest: Any, limit: Any
) -> None:  # fmt: skip
    """Solve one run; the body of :func:`solve_run_8` and :func:`solve_run_16`."""
    slots: Any = 0
    for x in range(lanes):
        slots = max(slots, np.int64(counts[b + x]))
        m[_HIGH + x] = ZERO
        m[_CROSS_BEFORE + x] = ZERO
        m[_CROSS_SLOT + x] = ZERO
        m[_SLOPE + x] = ONE
        m[_T + x] = ZERO
        # No step was taken yet: what the scratch holds of other pixels must not count as one.
        m[_LAST_T + x] = _NO_LAST_T
        m[_LAST_SLOPE + x] = ZERO
    for x in range(lanes):
        # Shorter lists are filled with Gaussians of no weight.
        for slot in range(np.int64(counts[b + x]), slots):
            place = at + slot * (LIST_VALUES * lanes) + x
            lists[place] = ZERO
            lists[place + lanes] = ZERO
            lists[place + 2 * lanes] = ZERO
    copy_run(lanes, m, _FINAL, m, TRANSMITTANCE + b)
    copy_run(lanes, m, _SHARPEST, m, SHARPEST + b)
    _clear(lanes, m)
    for slot in range(slots):
        _load_slot(lanes, m, lists, at, slot)
        _cross_slot(lanes, m, np.float32(slot))
    for x in range(lanes):
        place = at + np.int64(m[_CROSS_SLOT + x]) * (LIST_VALUES * lanes) + x
        m[_ALPHA + x] = lists[place]
        m[_PEAK + x] = lists[place + lanes]
        m[_SHARPNESS + x] = lists[place + 2 * lanes]
    _start(lanes, m, limit, max(nearest, ZERO))
    if nearest <= ZERO and max_run(lanes, m, _OPEN) > ZERO:
        # Some Gaussian may reach the camera: light must pass at depth 0 for a crossing to exist.
        copy_run(lanes, m, _GUESS, m, _T)
        for x in range(lanes):
            m[_T + x] = ZERO
        _clear(lanes, m)
        for slot in range(slots):
            _load_slot(lanes, m, lists, at, slot)
            _multiply_slot(lanes, m)
        for x in range(lanes):
            clear = (m[_PRODUCT + x] > ISO_LEVEL) & (m[_OPEN + x] > ZERO)
            guess = m[_GUESS + x]
            m[_T + x] = guess if clear else ZERO
            m[_OPEN + x] = ONE if clear else ZERO
    steps = 0
    while steps < _MAX_STEPS and max_run(lanes, m, _OPEN) > ZERO:
        while slots > 0:
            _load_slot(lanes, m, lists, at, slots - 1)
            if _matters(lanes, m):
                break
            slots -= 1
        _clear(lanes, m)
        for slot in range(slots):
            _load_slot(lanes, m, lists, at, slot)
            _multiply_slot(lanes, m)
        _step(lanes, m, steps & 1 if steps >= _NEWTON_STEPS else 0)
        steps += 1
    copy_run(lanes, m, DEPTH + b, m, _T)
    copy_run(lanes, m, SLOPE + b, m, _SLOPE)


@kernel(fast=True)
def solve_run_8(
    m: np.ndarray,
    b: int,
    lists: np.ndarray,
    counts: np.ndarray,
    at: int,
    nearest: float,
    limit: float,
) -> None:
    """Solve 8 pixels of a tile: z-depth (0 where there is none) and floored slope.

    Parameters
    ----------
    m : (n,) float32
        The tile's scratch; ``TRANSMITTANCE`` and ``SHARPEST`` are read, ``DEPTH`` and ``SLOPE``
        are written.
    b : int
        The run's first pixel within the tile.
    lists : (n,) float32
        Contributors; those of the run begin at ``at``, slot by slot.
    counts : (256,) uint32
        Length of each pixel's list.
    nearest : float32
        No Gaussian of the run has a density worth counting before this z-depth.
    limit : float32
        Largest final transmittance of a pixel that has a depth.
    """
    _solve(8, m, b, lists, counts, at, nearest, limit)


@kernel(fast=True)
def solve_run_16(
    m: np.ndarray,
    b: int,
    lists: np.ndarray,
    counts: np.ndarray,
    at: int,
    nearest: float,
    limit: float,
) -> None:
    """Solve 16 pixels of a tile, see :func:`solve_run_8`."""
    _solve(16, m, b, lists, counts, at, nearest, limit)
