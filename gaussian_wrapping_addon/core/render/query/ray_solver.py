# SPDX-License-Identifier: GPL-3.0-or-later
"""Solver of the 0.5-isosurface depth along a single ray.

The contributors are three parallel arrays: opacities before the cap of 0.99, z-depths of the peaks,
sharpnesses 1 / sigma^2 along the ray. The crossing is solved by Newton steps on
``log T`` inside a bracket (docs/method.md, section 2.4).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ... import tolerances
from ...kernels.compiled import inline
from ..simd.raster_math import ALPHA_MAX, HALF, ONE, TWO, WIDE_END, ZERO, exp_wide

# Converged: a step so small relative to the thinnest Gaussian's sigma along the ray that the
# second-order Taylor series of log T is exact in float32 ...
_STEP_SIGMAS = np.float32(5e-4)
# ... or a transmittance equal to 0.5 within its own rounding error ...
_LEVEL_MARGIN = np.float32(1.2e-7)
# ... or a bracket as narrow as the rounding error of the depth. A step below that error is not
# sufficient: a layer may be steep there and yet end before the level is reached.
_BRACKET_SHARE = np.float32(1.25e-7)
_MIN_STEP_SHARE = np.float32(1.25e-7)
"""Minimum step relative to the depth, so that steps can close the bracket."""
_POLISH_SIGMAS = np.float32(3e-3)
"""Longest final step. A longer one would leave the depth at which the slope is known, by which
gradients are divided; where T is nearly flat, its rounding error would make the step far too
long."""
_LEVEL_FAR, _FLAT = np.float32(0.05), np.float32(0.02)
"""For a layer thinner than the depth's rounding error, T jumps past 0.5 from a flat part and the
gradient is lost: too small is better than a thousand times too large."""
_MIN_SLOPE = np.float32(1e-12)
"""Keeps a step finite; such a step leaves the bracket."""
# Bounds of Halley's correction factor of a Newton step.
_MIN_CORRECTION, _MAX_CORRECTION = HALF, TWO
_NEWTON_STEPS = 8
"""After these, every second step is a bisection, which bounds the number of steps."""
_MAX_STEPS = 80
SLOPE_FLOOR = np.float32(tolerances.SLOPE_FLOOR)
"""Floor of -d(log T)/dt relative to 1/sigma along the ray of the Gaussian at which the blending
crosses 0.5 (docs/method.md, section 2.5)."""
_THIRD, _FIFTH = np.float32(1.0 / 3.0), np.float32(0.2)
# exp(-x / 2) is below 3e-7 beyond this x = sharpness d^2.
NEGLIGIBLE = np.float32(30.0)
TINY = np.float32(1e-30)


@inline
def transmittance_at(count: Any, t: Any, alphas: Any, peaks: Any, sharpnesses: Any) -> Any:
    """Return T at depth t."""
    product = ONE
    for c in range(count):
        ahead = max(peaks[c] - t, ZERO)
        density = alphas[c] * exp_wide(HALF * sharpnesses[c] * ahead * ahead)
        product *= ONE - min(density, ALPHA_MAX)
    return product


@inline
def _log_twice(value: Any) -> Any:
    """Return log(2 value), accurate near 0.5, with correct sign and monotonic elsewhere."""
    y = (TWO * value - ONE) / (TWO * value + ONE)
    square = y * y
    return TWO * y * (ONE + square * (_THIRD + square * _FIFTH))


@inline
def _log_derivatives(count: Any, t: Any, alphas: Any, peaks: Any, sharpnesses: Any) -> Any:
    """Return T, the slope -d(log T)/dt and the derivative of the slope, at depth t."""
    product, slope, growth = ONE, ZERO, ZERO
    for c in range(count):
        ahead = max(peaks[c] - t, ZERO)
        fall = HALF * sharpnesses[c] * ahead * ahead
        density = min(alphas[c] * exp_wide(fall), ALPHA_MAX)
        # 0 where the density does not depend on t; far behind, the square below could overflow.
        sharpness = sharpnesses[c] if ahead > ZERO and fall <= WIDE_END else ZERO
        log_slope = sharpness * ahead
        keep = ONE - density
        product *= keep
        odds = density / keep
        slope += odds * log_slope
        growth += odds * (log_slope * log_slope / keep - sharpness)
    return product, slope, growth


@inline
def solve_ray(
    count: Any, alphas: Any, peaks: Any, sharpnesses: Any, high: Any, guess: Any, sharpest: Any,
    alone: Any,
) -> Any:  # fmt: skip
    """Return where T crosses 0.5 between 0 and ``high``, and -d(log T)/dt there, floored."""
    t, low, found_slope = guess, ZERO, ZERO
    for number in range(_MAX_STEPS):
        product, slope, growth = _log_derivatives(count, t, alphas, peaks, sharpnesses)
        excess = _log_twice(max(product, TINY))
        if excess > ZERO:
            low = t
        else:
            high = t
        inverse_slope = ONE / max(slope, _MIN_SLOPE)
        newton = excess * inverse_slope
        correction = min(
            max(ONE + HALF * newton * growth * inverse_slope, _MIN_CORRECTION), _MAX_CORRECTION
        )
        step = newton / correction
        size = abs(step)
        sigmas = size * sharpest
        found_slope = slope
        closed = abs(excess) <= _LEVEL_MARGIN or high - low <= _BRACKET_SHARE * high
        if closed or sigmas < _STEP_SIGMAS:
            # Rounding may put a step this small on the bracket's end.
            if sigmas < _POLISH_SIGMAS:
                moved = min(max(t + step, low), high)
                found_slope = slope + growth * (moved - t)
                t = moved
            found_slope = max(found_slope, SLOPE_FLOOR * alone)
            if abs(excess) > _LEVEL_FAR and slope < _FLAT * alone:
                found_slope = TWO * alone
            break
        least = _MIN_STEP_SHARE * t
        moved = t + (step if size > least else (least if excess > ZERO else -least))
        newton_next = moved > low and moved < high
        newton_next = newton_next and (number < _NEWTON_STEPS or number % 2 == 0)
        t = moved if newton_next else HALF * (low + high)
    return t, max(found_slope, SLOPE_FLOOR * alone)
