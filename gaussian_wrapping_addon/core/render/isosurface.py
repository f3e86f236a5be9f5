# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled solver of the 0.5-isosurface depth of a tile, from records of its contributors.

Along a pixel's ray ``T(t) = prod_i (1 - min(0.99, alpha_i exp(-s_i max(t_i - t, 0)^2 / 2)))`` falls
with t; the depth is where it crosses 0.5 (method.md 2.4). Each pixel keeps a bracket, starts where
the Gaussian at which the blending crosses 0.5 would cross it alone, and takes Newton steps on
log T; a step that leaves the bracket, or too many steps, is replaced by bisection. One pass over
the records serves one step of all pixels of a tile that have not converged.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..compiled import inline
from .raster_math import (
    ALPHA_MAX,
    FAR,
    HALF,
    ISO_LEVEL,
    ONE,
    PLANE,
    TILE,
    TWO,
    ZERO,
    copy_run,
    exp_wide,
    max_run,
)

# Planes of the scratch array. The first five are shared with the blending.
TRANSMITTANCE = 0
ALPHA, PEAK, SHARPNESS = PLANE, 2 * PLANE, 3 * PLANE
SHARPEST = 4 * PLANE
_T = 5 * PLANE
"""Current z-depth; the answer at the end."""
SLOPE = 6 * PLANE
_LOW, _HIGH = 7 * PLANE, 8 * PLANE
_PRODUCT, _DERIVATIVE = 9 * PLANE, 10 * PLANE
# Before the iteration, the next planes hold the Gaussian at the crossing.
_CROSS_ALPHA, _CROSS_BEFORE = 11 * PLANE, 12 * PLANE
_CROSS_PEAK, _CROSS_SHARPNESS = 13 * PLANE, 14 * PLANE
_OPEN = 15 * PLANE
"""1 where the pixel has not converged."""
_REACH = 16 * PLANE
"""Depth of the open pixels, -1 elsewhere."""
SOLVER_END = 17 * PLANE
DEPTH = _T

_NEWTON_STEPS = 8
"""From here on every second step is a bisection."""
_MAX_STEPS = 80
# Converged: a Newton step below this share of the thinnest Gaussian's sigma along the ray ...
_STEP_SIGMAS = np.float32(2e-5)
# ... or below the rounding of the depth itself ...
_STEP_SHARE = np.float32(2.5e-7)
# ... or a transmittance equal to 0.5 within its own rounding.
_LEVEL_MARGIN = np.float32(3e-7)
SLOPE_FLOOR = np.float32(1e-3)
"""Floor of -d(log T)/dt in shares of the pixel's largest 1/sigma along the ray (method.md 2.5)."""
_NEWTON_FLOOR = np.float32(1e-6)
_THIRD, _FIFTH = np.float32(1.0 / 3.0), np.float32(0.2)
_TINY = np.float32(1e-30)


@inline
def _cross_run(lanes: Any, m: Any, b: Any) -> None:
    """Blend one record's alphas; note the Gaussian that crosses 0.5 and the deepest peak so far."""
    for x in range(lanes):
        alpha = min(m[ALPHA + b + x], ALPHA_MAX)
        before = m[_PRODUCT + b + x]
        after = before - alpha * before
        m[_PRODUCT + b + x] = after
        peak = m[PEAK + b + x]
        above = before > ISO_LEVEL
        reached = above & (alpha > ZERO)
        high = m[_HIGH + b + x]
        m[_HIGH + b + x] = max(high, peak if reached else ZERO)
        crosses = above & (after <= ISO_LEVEL)
        old = m[_CROSS_ALPHA + b + x]
        m[_CROSS_ALPHA + b + x] = alpha if crosses else old
        old = m[_CROSS_BEFORE + b + x]
        m[_CROSS_BEFORE + b + x] = before if crosses else old
        old = m[_CROSS_PEAK + b + x]
        m[_CROSS_PEAK + b + x] = peak if crosses else old
        sharpness = m[SHARPNESS + b + x]
        old = m[_CROSS_SHARPNESS + b + x]
        m[_CROSS_SHARPNESS + b + x] = sharpness if crosses else old


@inline
def _start_run(lanes: Any, m: Any, b: Any, limit: Any, nearest: Any) -> Any:
    """Set bracket and first guess of one run; return its largest depth, or -1 if none is open."""
    for x in range(lanes):
        through = m[TRANSMITTANCE + b + x]
        crossed = (m[_CROSS_ALPHA + b + x] > ZERO) & (through <= limit) & (through < ISO_LEVEL)
        # Alone, the Gaussian at the crossing lets 0.5 through where
        # exp(-s d^2 / 2) = ratio; log(ratio) by the series of artanh.
        light = m[_CROSS_ALPHA + b + x] * m[_CROSS_BEFORE + b + x]
        ratio = (m[_CROSS_BEFORE + b + x] - ISO_LEVEL) / max(light, _TINY)
        ratio = min(max(ratio, ZERO), ONE)
        y = (ratio - ONE) / (ratio + ONE)
        square = y * y
        log_ratio = TWO * y * (ONE + square * (_THIRD + square * _FIFTH))
        sharpness = max(m[_CROSS_SHARPNESS + b + x], _TINY)
        before = math.sqrt(max(-TWO * log_ratio / sharpness, ZERO))
        high = m[_HIGH + b + x]
        guess = m[_CROSS_PEAK + b + x] - before
        guess = guess if guess > nearest else HALF * (nearest + high)
        m[_LOW + b + x] = nearest
        m[_T + b + x] = guess if crossed else ZERO
        m[SLOPE + b + x] = ONE
        m[_OPEN + b + x] = ONE if crossed else ZERO
        m[_REACH + b + x] = guess if crossed else -ONE
    return max_run(lanes, m, _REACH + b)


@inline
def _clear_run(lanes: Any, m: Any, b: Any) -> None:
    """Begin a pass: product 1, derivative 0."""
    for x in range(lanes):
        m[_PRODUCT + b + x] = ONE
        m[_DERIVATIVE + b + x] = ZERO


@inline
def _multiply_run(lanes: Any, m: Any, b: Any) -> None:
    """Multiply one record's factors, and their derivative, into T at the current depths."""
    for x in range(lanes):
        before = max(m[PEAK + b + x] - m[_T + b + x], ZERO)
        pull = m[SHARPNESS + b + x] * before
        density = min(m[ALPHA + b + x] * exp_wide(HALF * pull * before), ALPHA_MAX)
        keep = ONE - density
        product = m[_PRODUCT + b + x]
        m[_DERIVATIVE + b + x] = m[_DERIVATIVE + b + x] * keep - product * density * pull
        m[_PRODUCT + b + x] = product * keep


@inline
def _step_run(lanes: Any, m: Any, b: Any, bisect: Any) -> Any:
    """Move the open pixels of one run; return the largest depth still open, or -1."""
    for x in range(lanes):
        t = m[_T + b + x]
        product = max(m[_PRODUCT + b + x], _TINY)
        y = (TWO * product - ONE) / (TWO * product + ONE)
        square = y * y
        excess = TWO * y * (ONE + square * (_THIRD + square * _FIFTH))  # log(T / 0.5)
        sharpest = math.sqrt(max(m[SHARPEST + b + x], _TINY))
        slope = -m[_DERIVATIVE + b + x] / product
        step = excess / max(slope, _NEWTON_FLOOR * sharpest)
        above = excess > ZERO
        is_open = m[_OPEN + b + x] > ZERO
        low = m[_LOW + b + x]
        high = m[_HIGH + b + x]
        low = t if above else low
        high = high if above else t
        moved = t + step
        newton = (moved > low) & (moved < high)
        taken = newton & (bisect == 0)
        size = abs(step)
        # Rounding may put a step this small on the bracket's end, hence no test for inside.
        done = size <= max(_STEP_SIGMAS / sharpest, _STEP_SHARE * t)
        done = done | (abs(excess) <= _LEVEL_MARGIN) | (high - low <= _STEP_SHARE * high)
        settled = min(max(moved, low), high)
        middle = HALF * (low + high)
        moved = moved if taken else middle
        moved = settled if done else moved
        m[_LOW + b + x] = low
        m[_HIGH + b + x] = high
        m[_T + b + x] = moved if is_open else t
        old = m[SLOPE + b + x]
        floored = max(slope, SLOPE_FLOOR * sharpest)
        m[SLOPE + b + x] = floored if is_open else old
        stays = is_open & (~done)
        m[_OPEN + b + x] = ONE if stays else ZERO
        m[_REACH + b + x] = moved if stays else -ONE
    return max_run(lanes, m, _REACH + b)


@inline
def _load_record(lanes: Any, m: Any, b: Any, records: Any, number: Any) -> None:
    """Bring one record to the planes of its run."""
    at = number * (3 * lanes)
    copy_run(lanes, m, ALPHA + b, records, at)
    copy_run(lanes, m, PEAK + b, records, at + lanes)
    copy_run(lanes, m, SHARPNESS + b, records, at + 2 * lanes)


@inline
def solve_tile(
    lanes: Any, m: Any, records: Any, record_runs: Any, record_fronts: Any, recorded: Any,
    live_rows: Any, live_columns: Any, limit: Any,
) -> None:  # fmt: skip
    """Solve all pixels of a tile: z-depth (0 where there is none) and floored slope.

    Reads the records, ``TRANSMITTANCE`` and ``SHARPEST``; writes ``DEPTH`` and ``SLOPE``.
    """
    runs = live_rows * (TILE // lanes)
    deepest = np.zeros(2 * TILE, np.float32)
    nearest = np.zeros(2 * TILE, np.float32)
    for run in range(runs):
        _clear_run(lanes, m, (run & (2 * TILE - 1)) * lanes)
    for run in range(2 * TILE):
        nearest[run] = FAR
    for number in range(recorded):
        run = np.int64(record_runs[number]) & (2 * TILE - 1)
        b = run * lanes
        _load_record(lanes, m, b, records, number)
        _cross_run(lanes, m, b)
        nearest[run] = min(nearest[run], record_fronts[number])
    is_open = False
    inside = False
    for run in range(runs):
        b = (run & (2 * TILE - 1)) * lanes
        inside |= nearest[run] <= ZERO
        deepest[run] = _start_run(lanes, m, b, limit, max(nearest[run], ZERO))
        is_open |= deepest[run] >= ZERO
    if not is_open:
        return

    if inside:
        # Some Gaussian may reach the camera: light must pass at depth 0 for a crossing to exist.
        for run in range(runs):
            b = (run & (2 * TILE - 1)) * lanes
            for x in range(lanes):
                m[_CROSS_PEAK + b + x] = m[_T + b + x]
                m[_T + b + x] = ZERO
            _clear_run(lanes, m, b)
        for number in range(recorded):
            b = (np.int64(record_runs[number]) & (2 * TILE - 1)) * lanes
            if record_fronts[number] <= ZERO:
                _load_record(lanes, m, b, records, number)
                _multiply_run(lanes, m, b)
        for run in range(runs):
            b = (run & (2 * TILE - 1)) * lanes
            for x in range(lanes):
                clear = (m[_PRODUCT + b + x] > ISO_LEVEL) & (m[_OPEN + b + x] > ZERO)
                guess = m[_CROSS_PEAK + b + x]
                m[_T + b + x] = guess if clear else ZERO
                m[_OPEN + b + x] = ONE if clear else ZERO
                m[_REACH + b + x] = guess if clear else -ONE
            deepest[run] = max_run(lanes, m, _REACH + b)

    for step in range(_MAX_STEPS):
        bisect = step & 1 if step >= _NEWTON_STEPS else 0
        for run in range(runs):
            _clear_run(lanes, m, (run & (2 * TILE - 1)) * lanes)
        for number in range(recorded):
            run = np.int64(record_runs[number]) & (2 * TILE - 1)
            # Gaussians wholly behind every open pixel of the run change nothing.
            if record_fronts[number] < deepest[run]:
                b = run * lanes
                _load_record(lanes, m, b, records, number)
                _multiply_run(lanes, m, b)
        is_open = False
        for run in range(runs):
            if deepest[run] >= ZERO:
                b = (run & (2 * TILE - 1)) * lanes
                deepest[run] = _step_run(lanes, m, b, bisect)
                is_open |= deepest[run] >= ZERO
        if not is_open:
            return
