# SPDX-License-Identifier: GPL-3.0-or-later
"""Vector code of the backward pass: one Gaussian and one block of pixels, with its sums."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from numba.core import types
from numba.extending import intrinsic

from ...kernels.compiled import inline
from ..simd import raster_math as constants
from ..simd.raster_math import FEATURES, STRIDE
from ..simd.simd import Block, State, Vector
from ..simd.simd_math import RayEvaluation, evaluate_rays, exp_wide, first_pixel, peak_depth

# Planes of the tile's scratch array: loss gradients on the features, then the pixels' state.
G0 = 0
TRANSMITTANCE, REMAINING = FEATURES, FEATURES + 1
DEPTH, LOG_T_GRADIENT = FEATURES + 2, FEATURES + 3
"""The isosurface depth, and the loss gradient on it divided by the slope of log T there."""
BACKWARD_PLANES = LOG_T_GRADIENT + 1

# Sums of one intersection: moments (1, x, y, xx, xy, yy) of the gradients on num and on den, the
# gradients on the squared distance and on the features; then those of the depth; then sums of
# absolute values.
NUM, DEN, DISTANCE, FEATURE = 0, 6, 12, 13
LIN, ALONG = FEATURE + FEATURES, FEATURE + FEATURES + 3
"""Moments (1, x, y) of the gradient on ``1 + p.d``, and the gradient on a0 over den."""
BASE_SUMS = LIN
DEPTH_SUMS = ALONG + 1


def sum_count(depth: bool, absolute: bool) -> int:
    """Return the number of sums per intersection."""
    return (DEPTH_SUMS if depth else BASE_SUMS) + (2 if absolute else 0)


def _gradient_intrinsic(lanes: int, depth: bool, absolute: bool) -> Any:
    @intrinsic
    def gradient(typingctx, m, bits, params, gaussian, x, y, sums):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            block = Block(lanes, context, builder)
            state, params_data = block.data(sig.args[0], args[0]), block.data(sig.args[2], args[2])
            totals = [State(block, 0.0) for _ in range(sum_count(depth, absolute))]

            def process_block(number: Any) -> None:
                left, top = first_pixel(block, number, args[4], args[5])
                rays = evaluate_rays(block, params_data, args[3], left, top)
                at = builder.mul(number, block.index(lanes), flags=("nuw", "nsw"))
                for which, value in _sums_of_block(block, state, at, rays, depth, absolute):
                    totals[which].set(totals[which].get() + value)

            block.each_bit(args[1], process_block)
            for number, total in enumerate(block.totals([total.get() for total in totals])):
                block.store(total, state, block.offset(args[6], number * lanes))
            return context.get_dummy_value()

        index, single = types.intp, types.float32
        return types.void(m, types.uint64, params, index, single, single, index), generate

    return gradient


def _sums_of_block(
    block: Block, state: Any, at: Any, rays: RayEvaluation, depth: bool, absolute: bool
) -> Iterator[tuple[int, Vector]]:
    """Advance the pixels of a block past one Gaussian; yield (index, term) of its sums."""
    row, dx, dy = rays.row, rays.dx, rays.dy

    def plane(number: int) -> Any:
        return block.offset(at, number * STRIDE)

    before = block.load(state, plane(TRANSMITTANCE))
    contributes = (rays.alpha >= float(constants.ALPHA_MIN)) & (
        before >= float(constants.TRANSMITTANCE_MIN)
    )
    alpha = contributes.select(rays.alpha, 0.0)
    weight = alpha.times(before)
    gradients = [block.load(state, plane(G0 + feature)) for feature in range(FEATURES)]
    q = gradients[0] * row[13]
    for feature in range(1, FEATURES):
        q = q + gradients[feature] * row[13 + feature]
    remaining = block.load(state, plane(REMAINING)) - weight * q
    block.store(remaining, state, plane(REMAINING))
    block.store(before - weight, state, plane(TRANSMITTANCE))
    g_alpha = before * q - remaining / (1.0 - alpha)
    free = rays.raw < float(constants.ALPHA_MAX)
    g_distance = free.select(alpha * g_alpha * -0.5, 0.0)
    g_lin = block.vector(0.0)
    if depth:
        peak = peak_depth(rays)
        ahead = (peak - block.load(state, plane(DEPTH))).max(0.0)
        # At most FINITE_PULL on any lane, so that products with 0 stay 0; the exponential's
        # argument may overflow where nothing contributes.
        fall = rays.den * row[12] * ahead
        density = rays.raw * exp_wide(fall * ahead, 0.5)
        uncapped = contributes & (density < float(constants.ALPHA_MAX))
        density = density.min(float(constants.ALPHA_MAX))
        # Gradient on log G, through log(1 - G).
        g_log = block.load(state, plane(LOG_T_GRADIENT)) * density / (density - 1.0)
        g_log = uncapped.select(g_log, 0.0)
        g_distance = g_distance - g_log * 0.5
        g_peak = g_log * fall * -1.0
        g_sharpness = g_log * ahead * ahead * -0.5
        g_num = g_distance * rays.inverse
        g_den = g_sharpness * row[12] - (g_num * rays.distance + g_peak * peak * rays.inverse)
        g_lin = g_peak * rays.inverse * row[10]
        yield LIN, g_lin
        yield LIN + 1, g_lin * dx
        yield LIN + 2, g_lin * dy
        yield ALONG, g_sharpness * rays.den
    else:
        g_num = g_distance * rays.inverse
        g_den = g_num * rays.distance * -1.0
    for base, value in ((NUM, g_num), (DEN, g_den)):
        along_x, along_y = value * dx, value * dy
        yield base, value
        yield base + 1, along_x
        yield base + 2, along_y
        yield base + 3, along_x * dx
        yield base + 4, along_x * dy
        yield base + 5, along_y * dy
    yield DISTANCE, g_distance
    for feature in range(FEATURES):
        yield FEATURE + feature, weight * gradients[feature]
    if absolute:
        g_u = g_num * (dx * (row[2] * 2.0) + dy * row[3])
        g_u = g_u + g_den * ((dx * row[7] + row[5]) * 2.0 + dy * row[8]) + g_lin * row[5]
        g_v = g_num * (dy * (row[4] * 2.0) + dx * row[3])
        g_v = g_v + g_den * ((dy * row[9] + row[6]) * 2.0 + dx * row[8]) + g_lin * row[6]
        first = DEPTH_SUMS if depth else BASE_SUMS
        yield first, g_u.abs()
        yield first + 1, g_v.abs()


_base_16 = _gradient_intrinsic(16, False, False)
_depth_16 = _gradient_intrinsic(16, True, False)
_absolute_16 = _gradient_intrinsic(16, False, True)
_depth_absolute_16 = _gradient_intrinsic(16, True, True)
_base_8 = _gradient_intrinsic(8, False, False)
_depth_8 = _gradient_intrinsic(8, True, False)
_absolute_8 = _gradient_intrinsic(8, False, True)
_depth_absolute_8 = _gradient_intrinsic(8, True, True)


@inline
def sum_intersection_gradient(
    lanes: Any, depth: Any, absolute: Any, m: Any, bits: Any, params: Any, i: Any, x: Any, y: Any,
    sums: Any,
) -> None:  # fmt: skip
    """Advance the blocks with ``bits`` set past Gaussian ``i``; write its sums to ``m[sums]``.

    Parameters
    ----------
    lanes : int
    depth, absolute : bool
        Include the gradient of the depth; include sums of absolute values.
    x, y : float32
        Centre of the tile's first pixel, pixels.
    """
    if lanes == 16:
        if depth:
            if absolute:
                _depth_absolute_16(m, bits, params, i, x, y, sums)
            else:
                _depth_16(m, bits, params, i, x, y, sums)
        elif absolute:
            _absolute_16(m, bits, params, i, x, y, sums)
        else:
            _base_16(m, bits, params, i, x, y, sums)
    elif depth:
        if absolute:
            _depth_absolute_8(m, bits, params, i, x, y, sums)
        else:
            _depth_8(m, bits, params, i, x, y, sums)
    elif absolute:
        _absolute_8(m, bits, params, i, x, y, sums)
    else:
        _base_8(m, bits, params, i, x, y, sums)
