# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth at which the transmittance of a ray falls to 0.5."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba.core import cgutils, types

from .. import limits
from ..compiled import inline
from . import simd as constants
from .simd import (
    DEPTH,
    FORWARD_PLANES,
    ONE,
    SLOPE,
    STRIDE,
    TILE,
    ZERO,
    Block,
    Mask,
    State,
    Vector,
    compile_time,
    copy_run,
    simd_math_exp_wide,
)

# -- Vector code of the isosurface solver: one block of pixels and its contributor list -----------


LIST_VALUES = 3
"""Values per entry: opacity before the cap (0 where none), z-depth of the peak, sharpness
(1 / sigma^2 along the ray)."""

# One vector each, after the planes of the tile's scratch array.
AT_DEPTH, SLOPES = FORWARD_PLANES * STRIDE, FORWARD_PLANES * STRIDE + TILE
_LOW, _HIGH, _OPEN = AT_DEPTH + 2 * TILE, AT_DEPTH + 3 * TILE, AT_DEPTH + 4 * TILE
_PRODUCT, _FIRST, _SECOND = AT_DEPTH + 5 * TILE, AT_DEPTH + 6 * TILE, AT_DEPTH + 7 * TILE
_SHARPEST, NEAREST = AT_DEPTH + 8 * TILE, AT_DEPTH + 9 * TILE
_PREFIX = AT_DEPTH + 10 * TILE
"""Transmittance of the Gaussians that lie wholly in front of the brackets."""
_AT_CROSSING = AT_DEPTH + 11 * TILE
"""1/sigma of the Gaussian at which the blending crosses 0.5."""
SOLVER_VALUES = 12 * TILE

_NEWTON_FLOOR = 1e-6
_LOG_2 = math.log(2.0)
_MIN_OPTICAL_DEPTH = 1e-3
"""Lower bound of -log T where its logarithm is taken: far from 0.5 no slope is extrapolated."""
_APPROXIMATE_STEPS = 2
"""Initial Newton steps on a cheap approximation of T, at half the cost of an exact step each."""
# Bounds of Halley's correction factor of a Newton step.
_MIN_CORRECTION, _MAX_CORRECTION = 0.5, 2.0
# Converged: the cube of the step, in units of the thinnest Gaussian's sigma along the ray, is below
# this fraction of the depth, and the step itself small enough to extrapolate the slope ...
_CUBE_SHARE, _STEP_SIGMAS = 2e-7, 0.003
_STEP_SIGMAS_ALONE = 1e-5
# ... or the step is below the rounding error of the depth, and not because of a steep layer that
# may end before the level is reached ...
_STEP_SHARE, _LEVEL_NEAR = 2.5e-7, 1e-3
# ... or the transmittance equals 0.5 within its own rounding error.
_LEVEL_MARGIN = 3e-7
_LEVEL_FAR, _FLAT = 0.05, 0.02
_COARSE = 8e3
"""Depth in sigmas beyond which the rounding of a float32 depth exceeds 1e-3 sigma."""
# exp(-x / 2) is below 3e-7 beyond this x = sharpness d^2.
NEGLIGIBLE = 30.0
_TINY = 1e-30


def entry_index(block: Block, number: Any) -> Any:
    """Return the index of the first value of a list entry."""
    size = block.index(LIST_VALUES * block.lanes)
    return block.builder.mul(number, size, flags=("nuw", "nsw"))


@dataclass(frozen=True)
class Crossing:
    """Where the blending of each pixel crossed 0.5: the Gaussian there and the transmittances."""

    before: Vector  # transmittance in front of that Gaussian; 0 where nothing crosses
    alpha: Vector
    peak: Vector
    sharpness: Vector
    final: Vector  # final transmittance
    high: Vector  # deepest peak up to the crossing


def start_solver(
    block: Block, state: Any, crossing: Crossing, sharpest: Vector, nearest: Any, limit: Any
) -> Any:
    """Write brackets and initial guesses; return as bits which pixels have an isosurface."""
    crossed = (
        (crossing.before > 0.0)
        & (crossing.final <= block.splat(limit))
        & (crossing.final < constants.ISO_LEVEL)
    )
    # The Gaussian at the crossing alone reaches T = 0.5 where exp(-s d^2 / 2) = ratio.
    light = crossing.alpha.min(float(constants.ALPHA_MAX)) * crossing.before
    ratio = ((crossing.before - float(constants.ISO_LEVEL)) / light.max(_TINY)).max(_TINY).min(1.0)
    ahead = (ratio.log() * -2.0 / crossing.sharpness.max(_TINY)).max(0.0).sqrt()
    low = block.splat(nearest).max(0.0)
    guess = crossing.peak - ahead
    guess = (guess > low).select(guess, (low + crossing.high) * 0.5)
    for value, plane in (
        (crossed.select(guess, 0.0), AT_DEPTH),
        (1.0, SLOPES),
        (low, _LOW),
        (crossing.high, _HIGH),
        (sharpest.max(_TINY).sqrt(), _SHARPEST),
        (low, NEAREST),
        (1.0, _PREFIX),
        (crossing.sharpness.max(0.0).sqrt(), _AT_CROSSING),
        (crossed.select(1.0, 0.0), _OPEN),
    ):
        block.store(value, state, block.index(plane))
    return crossed.bits()


class _Solver:
    """Access to the solver's vectors in the scratch array and to the entries of its block."""

    def __init__(self, lanes: int, context: Any, builder: Any, sig: Any, args: Any) -> None:
        self.block = Block(lanes, context, builder)
        self.state = self.block.data(sig.args[1], args[1])

    def read(self, plane: int) -> Vector:
        """Return a vector of the solver's state."""
        return self.block.load(self.state, self.block.index(plane))

    def write(self, value: Vector | float, plane: int) -> None:
        """Store a vector of the solver's state."""
        self.block.store(value, self.state, self.block.index(plane))

    def entry(self, lists: Any, number: Any) -> tuple[list[Any], list[Vector]]:
        """Return the offsets of an entry's columns, and the columns."""
        block = self.block
        base = entry_index(block, number)
        offsets = [block.offset(base, column * block.lanes) for column in range(LIST_VALUES)]
        return offsets, [block.load(lists, offset) for offset in offsets]

    def is_open(self) -> Mask:
        """Return which pixels are not yet solved."""
        return self.read(_OPEN) > 0.0

    def set_open(self, is_open: Mask) -> Any:
        """Store which pixels are not yet solved; return them as bits."""
        self.write(is_open.select(1.0, 0.0), _OPEN)
        return is_open.bits()


@compile_time
def _evaluate(typingctx, lanes, m, lists, count, factor):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        solver = _Solver(lanes.literal_value, context, builder, sig, args)
        block, entries = solver.block, solver.block.data(sig.args[2], args[2])
        t = solver.read(AT_DEPTH) * block.splat(args[4])
        product, slope, curvature = (
            State(block, solver.read(_PREFIX)), State(block, 0.0), State(block, 0.0),
        )  # fmt: skip

        def multiply(n: Any) -> None:
            _, (alpha, peak, sharpness) = solver.entry(entries, n)
            ahead = (peak - t).max(0.0)
            log_slope = sharpness * ahead
            density = (alpha * simd_math_exp_wide(log_slope * ahead, 0.5)).min(
                float(constants.ALPHA_MAX)
            )
            keep = 1.0 - density
            rise = density * log_slope  # d(density) / dt
            growth = density * (log_slope * log_slope - (ahead > 0.0).select(sharpness, 0.0))
            p, d = product.get(), slope.get()
            curvature.set(curvature.get() * keep - (d * 2.0 * rise + p * growth))
            slope.set(d * keep - p * rise)
            product.set(p * keep)

        block.repeat(args[3], multiply)
        solver.write(product.get(), _PRODUCT)
        solver.write(slope.get(), _FIRST)
        solver.write(curvature.get(), _SECOND)
        return context.get_dummy_value()

    index = types.intp
    return types.void(lanes, m, lists, index, types.float32), generate


def _log_of_twice(product: Vector) -> Vector:
    """Return log(2 product) by the artanh series: accurate near 0.5, monotonic elsewhere."""
    twice = product * 2.0
    y = (twice - 1.0) / (twice + 1.0)
    square = y * y
    return y * ((square * (2 / 5) + 2 / 3) * square + 2.0)


@compile_time
def _approach(typingctx, lanes, m, lists, count):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        solver = _Solver(lanes.literal_value, context, builder, sig, args)
        block, entries = solver.block, solver.block.data(sig.args[2], args[2])
        guess, sharpest = State(block, solver.read(AT_DEPTH)), solver.read(_SHARPEST)
        low, high = State(block, solver.read(_LOW)), State(block, solver.read(_HIGH))
        product, slope = State(block, 1.0), State(block, 0.0)

        def multiply(n: Any) -> None:
            _, (alpha, peak, sharpness) = solver.entry(entries, n)
            ahead = (peak - guess.get()).max(0.0)
            log_slope = sharpness * ahead
            # (1 - x / 8)^8 approximates exp(-x).
            fall = (1.0 - log_slope * ahead * (0.5 / 8.0)).max(0.0)
            fall = fall * fall
            fall = fall * fall
            density = (alpha * (fall * fall)).min(float(constants.ALPHA_MAX))
            keep = 1.0 - density
            slope.set(slope.get() * keep - product.get() * (density * log_slope))
            product.set(product.get() * keep)

        def iterate(_: Any) -> None:
            product.set(1.0)
            slope.set(0.0)
            block.repeat(args[3], multiply)
            t, light = guess.get(), product.get().max(_TINY)
            above = light > constants.ISO_LEVEL
            low.set(above.select(t, low.get()))
            high.set(above.select(high.get(), t))
            excess = _log_of_twice(light)
            moved = t + excess * light / (slope.get() * -1.0).max(sharpest * light * _NEWTON_FLOOR)
            inside = (moved > low.get()) & (moved < high.get())
            guess.set(inside.select(moved, (low.get() + high.get()) * 0.5))

        block.repeat(block.index(_APPROXIMATE_STEPS), iterate)
        solver.write(solver.is_open().select(guess.get(), 0.0), AT_DEPTH)
        return context.get_dummy_value()

    return types.void(lanes, m, lists, types.intp), generate


@compile_time
def _compact(typingctx, lanes, m, lists, count):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        solver = _Solver(lanes.literal_value, context, builder, sig, args)
        block, entries = solver.block, solver.block.data(sig.args[2], args[2])
        low, high, is_open = solver.read(_LOW), solver.read(_HIGH), solver.is_open()
        prefix = State(block, solver.read(_PREFIX))
        kept = cgutils.alloca_once_value(builder, block.index(0))

        def move(n: Any) -> None:
            _, (alpha, peak, sharpness) = solver.entry(entries, n)
            behind = (peak - high).max(0.0)
            changes = (peak > low) & (alpha > 0.0) & (sharpness * behind * behind < NEGLIGIBLE)
            matters = (changes & is_open).any()
            target = builder.load(kept)
            offsets, _ = solver.entry(entries, target)
            for offset, value in zip(offsets, (alpha, peak, sharpness), strict=True):
                block.store(value, entries, offset)
            builder.store(builder.add(target, builder.zext(matters, target.type)), kept)
            passed = (peak <= low).select(1.0 - alpha.min(float(constants.ALPHA_MAX)), 1.0)
            factor = builder.select(matters, block.vector(1.0).value, passed.value)
            prefix.set(prefix.get() * Vector(block, factor))

        block.repeat(args[3], move)
        solver.write(prefix.get(), _PREFIX)
        return builder.load(kept)

    index = types.intp
    return types.intp(lanes, m, lists, index), generate


@compile_time
def _drop_occluded(typingctx, lanes, m):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        solver = _Solver(lanes.literal_value, context, builder, sig, args)
        is_open = solver.is_open() & (solver.read(_PRODUCT) > constants.ISO_LEVEL)
        solver.write(is_open.select(solver.read(AT_DEPTH), 0.0), AT_DEPTH)
        return solver.set_open(is_open)

    return types.uint64(lanes, m), generate


@compile_time
def _open_pixels(typingctx, lanes, m):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _Solver(lanes.literal_value, context, builder, sig, args).is_open().bits()

    return types.uint64(lanes, m), generate


@compile_time
def _step(typingctx, lanes, m, bisect):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        solver = _Solver(lanes.literal_value, context, builder, sig, args)
        block, is_open = solver.block, solver.is_open()
        t, low, high = solver.read(AT_DEPTH), solver.read(_LOW), solver.read(_HIGH)
        sharpest, product = solver.read(_SHARPEST), solver.read(_PRODUCT).max(_TINY)
        excess = _log_of_twice(product)
        # First and second derivative of -log T, and Halley's correction of the Newton step.
        inverse = 1.0 / product
        slope = solver.read(_FIRST) * inverse * -1.0
        growth = slope * slope - solver.read(_SECOND) * inverse
        floored = slope.max(sharpest * _NEWTON_FLOOR)
        inverse_slope = 1.0 / floored
        newton = excess * inverse_slope
        move = newton / (newton * growth * inverse_slope * 0.5 + 1.0).max(_MIN_CORRECTION).min(
            _MAX_CORRECTION
        )
        above = excess > 0.0
        low = above.select(t, low)
        high = above.select(high, t)
        moved = t + move
        size = move.abs()
        inside = (moved > low) & (moved < high) & (block.splat(args[2]) <= 0.0)
        sigmas = size * sharpest
        small = (sigmas < _STEP_SIGMAS) & (t * sharpest < _COARSE)
        done = small & (sigmas * sigmas * size <= t * _CUBE_SHARE)
        level = excess.abs()
        done = done | (sigmas < _STEP_SIGMAS_ALONE)
        done = done | ((size <= t * _STEP_SHARE) & (level < _LEVEL_NEAR))
        done = done | (level <= _LEVEL_MARGIN) | (high - low <= high * _STEP_SHARE)
        # A small last step is taken and the slope extrapolated over it: log(-log T) is a
        # parabola in front of a single Gaussian. Otherwise, or if the depth's rounding error is
        # a large part of a sigma, the pixel stays where the slope is known, because the
        # gradient must be that of the stored depth. Rounding may put the step on the bracket's
        # end, hence no test for inside.
        settled = small.select(moved.max(low).min(high), t)
        moved = done.select(settled, inside.select(moved, (low + high) * 0.5))
        over = settled - t
        depth = (_LOG_2 - excess).max(_MIN_OPTICAL_DEPTH)
        ratio = slope / depth
        ratio_change = (growth / depth - ratio * ratio) * over
        gain = (ratio + ratio_change * 0.5) * over
        final = (ratio + ratio_change) * depth * ((gain * 0.5 + 1.0) * gain + 1.0)
        final = small.select(final, slope)
        # For a layer thinner than the depth's rounding error, T jumps past 0.5 from a flat part
        # and the gradient is lost: too small is better than a thousand times too large.
        alone = solver.read(_AT_CROSSING)
        lost = (level > _LEVEL_FAR) & (slope < alone * _FLAT)
        final = lost.select(alone * 2.0, final.max(alone * limits.SLOPE_FLOOR))
        solver.write(low, _LOW)
        solver.write(high, _HIGH)
        solver.write(is_open.select(moved, t), AT_DEPTH)
        solver.write(is_open.select(final, solver.read(SLOPES)), SLOPES)
        return solver.set_open(is_open & ~done)

    return types.uint64(lanes, m, types.float32), generate


# -- Compiled solver of the 0.5-isosurface depth of a block of pixels, from its contributor list
#
# Along a pixel's ray ``T(t) = prod_i (1 - min(0.99, alpha_i exp(-s_i max(t_i - t, 0)^2 / 2)))``
# falls with t; the depth is where it crosses 0.5 (docs/method.md, section 2.4). Each pixel keeps
# a bracket, starts where the Gaussian at which the blending crosses 0.5 would cross it alone, and
# takes Halley steps on log T. A step that leaves the bracket, or every second one after the first
# few, is replaced by bisection.


_NEWTON_STEPS = 8
"""After these, every second step is a bisection, which bounds the number of steps."""
_MAX_STEPS = 80
_NO_PIXELS = np.uint64(0)


@inline
def solve_block(lanes: Any, m: Any, b: Any, lists: Any, count: Any) -> None:
    """Solve one block: z-depth (0 where there is none) and floored slope of its pixels.

    The tile's scratch ``m`` holds brackets and initial guesses from blending, and receives both
    from ``b`` on, the start of the block in each plane. ``lists`` has ``count`` entries, none if no
    pixel has an isosurface; they are reordered.
    """
    is_open = _NO_PIXELS
    if count > 0:
        is_open = _open_pixels(lanes, m)
    if is_open != _NO_PIXELS and m[NEAREST] <= ZERO:
        # Some Gaussian may reach the camera: a crossing needs T > 0.5 at depth 0.
        _evaluate(lanes, m, lists, count, ZERO)
        is_open = _drop_occluded(lanes, m)
    if is_open != _NO_PIXELS:
        _approach(lanes, m, lists, count)
    steps = 0
    while is_open != _NO_PIXELS and steps < _MAX_STEPS:
        bisect = ONE if steps >= _NEWTON_STEPS and steps & 1 else ZERO
        if steps > 0 and steps & 1 == 0:
            count = _compact(lanes, m, lists, count)
        _evaluate(lanes, m, lists, count, ONE)
        is_open = _step(lanes, m, bisect)
        steps += 1
    copy_run(lanes, m, DEPTH * STRIDE + b, m, AT_DEPTH)
    copy_run(lanes, m, SLOPE * STRIDE + b, m, SLOPES)
