# SPDX-License-Identifier: GPL-3.0-or-later
"""Blocks of pixels blended, forward and backward: the inner loops."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types

from . import simd as constants
from .isosurface import LIST_VALUES, NEGLIGIBLE, Crossing, entry_index, start_solver
from .simd import (
    ALPHA_MIN,
    BEST,
    BEST_AT,
    F0,
    FEATURES,
    STRIDE,
    TRANSMITTANCE,
    TRANSMITTANCE_MIN,
    Block,
    Mask,
    RayEvaluation,
    State,
    Vector,
    compile_time,
    evaluate_rays,
    first_pixel,
    peak_depth,
    simd_math_exp_wide,
)

# -- Vector code of the forward pass: blends all Gaussians of a block of pixels in registers ------
#
# For the depth, each Gaussian that can affect it is appended to the block's list: those met
# before the transmittance of some pixel has crossed 0.5, and those whose density reaches back in
# front of the deepest peak before that crossing.


_COLOR_COLUMN, _SHARPNESS_COLUMN = 13, 12


class _DepthRecord:
    """State that blending keeps for the depth solver: the list of entries and the 0.5 crossing."""

    def __init__(self, block: Block, lists: Any) -> None:
        self.block, self.lists = block, lists
        self.count = cgutils.alloca_once_value(block.builder, block.index(0))
        self.high, self.sharpest = State(block, 0.0), State(block, 0.0)
        # Of the Gaussian at the crossing: the transmittance in front of it, then its entry.
        self.crossing = [State(block, 0.0) for _ in range(1 + LIST_VALUES)]

    def sharpen(self, rays: RayEvaluation, contributes: Mask) -> Vector:
        """Return a Gaussian's sharpness along the rays; update the maximum."""
        sharpness = rays.den * rays.row[_SHARPNESS_COLUMN]
        known = self.sharpest.get()
        self.sharpest.set((contributes & (sharpness > known)).select(sharpness, known))
        return sharpness

    def add_before(
        self, rays: RayEvaluation, contributes: Mask, before: Vector, after: Vector
    ) -> None:
        """Record a Gaussian while some pixel has not crossed 0.5."""
        peak, sharpness = peak_depth(rays), self.sharpen(rays, contributes)
        above = before > constants.ISO_LEVEL
        high = self.high.get()
        self.high.set((contributes & above & (peak > high)).select(peak, high))
        values = contributes.select(rays.raw, 0.0), peak, sharpness
        crosses = above & (after <= constants.ISO_LEVEL)
        for kept, value in zip(self.crossing, (before, *values), strict=True):
            kept.set(crosses.select(value, kept.get()))
        self._append(values, contributes)

    def add_behind(self, rays: RayEvaluation, contributes: Mask) -> None:
        """Record a Gaussian behind all crossings if its density reaches back to the brackets."""
        peak, sharpness = peak_depth(rays), self.sharpen(rays, contributes)
        behind = (peak - self.high.get()).max(0.0)
        matters = contributes & (sharpness * behind * behind < NEGLIGIBLE)
        self._append((contributes.select(rays.raw, 0.0), peak, sharpness), matters)

    def _append(self, values: tuple[Vector, ...], matters: Mask) -> None:
        block, builder = self.block, self.block.builder
        count = builder.load(self.count)
        base = entry_index(block, count)
        for column, value in enumerate(values):
            block.store(value, self.lists, block.offset(base, column * block.lanes))
        builder.store(builder.add(count, builder.zext(matters.any(), count.type)), self.count)


@dataclass(frozen=True)
class _Weights:
    """Blending weights per intersection, and the strongest Gaussian of each pixel."""

    intersection_weights: Any
    intersection_slots: Any
    begin: Any
    best: State
    best_at: State

    def add(self, block: Block, weight: Vector, intersection: Any) -> None:
        """Add the weights of one intersection in one block."""
        builder = block.builder
        best = self.best.get()
        stronger = weight > best
        self.best.set(stronger.select(weight, best))
        number = builder.sitofp(builder.sub(intersection, self.begin), ir.FloatType())
        self.best_at.set(stronger.select(block.splat(number), self.best_at.get()))
        slot = builder.sext(
            builder.load(builder.gep(self.intersection_slots, [intersection], inbounds=True)),
            intersection.type,
        )
        total = builder.gep(
            self.intersection_weights, [builder.mul(slot, block.index(2))], inbounds=True
        )
        largest = builder.gep(total, [block.index(1)], inbounds=True)
        builder.store(builder.fadd(builder.load(total), weight.total()), total)
        now, before = weight.largest(), builder.load(largest)
        more = builder.fcmp_ordered(">", now, before)
        builder.store(builder.select(more, now, before), largest)


@compile_time
def blend_block(  # type: ignore[no-untyped-def]
    typingctx, lanes, depth, weights, m, number, params, gaussian_ids, intersection_slots,
    contributors, first, count, begin, x, y, lists, nearest_depths, limit, intersection_weights,
):  # fmt: skip
    """Blend ``contributors[first .. first + count]`` into a block; return its list's length.

    ``lanes``, ``depth`` (write the entries to ``lists`` and initialise the solver) and ``weights``
    (collect blending weights) are literals. ``m`` is the tile's scratch, ``begin`` its first
    intersection, to which indices of the strongest Gaussians are relative, and ``x, y`` the centre
    of its first pixel. ``nearest_depths`` holds, for each of its intersections, the nearest z-depth
    that it or a later one reaches; ``limit`` is the largest final transmittance with a depth.
    """

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        block = Block(lanes.literal_value, context, builder)
        m_data, params_data, ids, slots, contributor_list, entries, nearest_data, sums = (
            block.data(sig.args[k], args[k]) for k in (3, 5, 6, 7, 8, 14, 15, 17)
        )
        number_, first_, count_, begin_, x_, y_, limit_ = (
            args[k] for k in (4, 9, 10, 11, 12, 13, 16)
        )
        left, top = first_pixel(block, number_, x_, y_)
        planes = builder.mul(number_, block.index(block.lanes), flags=("nuw", "nsw"))

        def plane(which: int) -> Any:
            return block.offset(planes, which * STRIDE)

        def contributor_at(n: Any) -> Any:
            pointer = builder.gep(contributor_list, [builder.add(first_, n)], inbounds=True)
            return builder.sext(builder.load(pointer), first_.type)

        transmittance = State(block, block.load(m_data, plane(TRANSMITTANCE)))
        features = [State(block, 0.0) for _ in range(FEATURES)]
        gathered = (
            _Weights(sums, slots, begin_, State(block, 0.0), State(block, 0.0))
            if weights.literal_value
            else None
        )

        def blend_one(n: Any) -> tuple[RayEvaluation, Mask, Vector, Vector]:
            """Blend one Gaussian; return also the transmittance before and behind it."""
            intersection = contributor_at(n)
            which = builder.load(builder.gep(ids, [intersection], inbounds=True))
            rays = evaluate_rays(
                block, params_data, builder.sext(which, intersection.type), left, top
            )
            before = transmittance.get()
            contributes = (rays.alpha >= float(ALPHA_MIN)) & (before >= float(TRANSMITTANCE_MIN))
            weight = contributes.select(rays.alpha.times(before), 0.0)
            after = before - weight
            transmittance.set(after)
            for feature, state in enumerate(features):
                state.set(state.get() + weight * rays.row[_COLOR_COLUMN + feature])
            if gathered is not None:
                gathered.add(block, weight, intersection)
            return rays, contributes, before, after

        always = ir.Constant(ir.IntType(1), 1)
        cursor = cgutils.alloca_once_value(builder, block.index(0))
        record = _DepthRecord(block, entries) if depth.literal_value else None
        if record is not None:

            def cross(n: Any) -> Any:
                rays, contributes, before, after = blend_one(n)
                record.add_before(rays, contributes, before, after)
                return (after > constants.ISO_LEVEL).any()

            def trail(n: Any) -> Any:
                rays, contributes, _, _ = blend_one(n)
                record.add_behind(rays, contributes)
                return always

            block.walk(cursor, count_, cross, lambda n: always)
            # Stop recording once no later intersection reaches back to the last bracket.
            deepest = record.high.get().largest()

            def reaches_back(n: Any) -> Any:
                offset = builder.sub(contributor_at(n), begin_)
                front = builder.load(builder.gep(nearest_data, [offset], inbounds=True))
                return builder.fcmp_ordered("<", front, deepest)

            block.walk(cursor, count_, trail, reaches_back)

        def finish(n: Any) -> Any:
            _, _, _, after = blend_one(n)
            return (after >= float(TRANSMITTANCE_MIN)).any()

        block.walk(cursor, count_, finish, lambda n: always)
        block.store(transmittance.get(), m_data, plane(TRANSMITTANCE))
        for feature, state in enumerate(features):
            block.store(state.get(), m_data, plane(F0 + feature))
        if gathered is not None:
            block.store(gathered.best.get(), m_data, plane(BEST))
            block.store(gathered.best_at.get(), m_data, plane(BEST_AT))
        if record is None:
            return block.index(0)
        before, alpha, peak, sharpness = (kept.get() for kept in record.crossing)
        crossing = Crossing(before, alpha, peak, sharpness, transmittance.get(), record.high.get())
        nearest = builder.load(nearest_data)
        opened = start_solver(block, m_data, crossing, record.sharpest.get(), nearest, limit_)
        # Without a pixel to solve there are no entries.
        none_open = builder.icmp_unsigned("==", opened, block.index(0))
        return builder.select(none_open, block.index(0), builder.load(record.count))

    index, single = types.intp, types.float32
    signature = types.intp(
        lanes, depth, weights, m, index, params, gaussian_ids, intersection_slots, contributors,
        index, index, index, single, single, lists, nearest_depths, single, intersection_weights,
    )  # fmt: skip
    return signature, generate


# -- Vector code of the backward pass: one Gaussian and one block of pixels, with its sums --------


# Planes of the tile's scratch array: loss gradients on the features, then the pixels' state.
G0 = 0
BACKWARD_TRANSMITTANCE, REMAINING = FEATURES, FEATURES + 1
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


def _sums_of_block(
    block: Block, state: Any, at: Any, rays: RayEvaluation, depth: bool, absolute: bool
) -> Iterator[tuple[int, Vector]]:
    """Advance the pixels of a block past one Gaussian; yield (index, term) of its sums."""
    row, dx, dy = rays.row, rays.dx, rays.dy

    def plane(number: int) -> Any:
        return block.offset(at, number * STRIDE)

    before = block.load(state, plane(BACKWARD_TRANSMITTANCE))
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
    block.store(before - weight, state, plane(BACKWARD_TRANSMITTANCE))
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
        density = rays.raw * simd_math_exp_wide(fall * ahead, 0.5)
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


@compile_time
def sum_intersection_gradient(  # type: ignore[no-untyped-def]
    typingctx, lanes, depth, absolute, m, bits, params, gaussian, x, y, sums
):
    """Advance the blocks with ``bits`` set past a Gaussian; write its sums to ``m[sums ..]``.

    ``lanes``, ``depth`` (include its gradient) and ``absolute`` (include sums of absolute values)
    are literals; ``x, y`` is the centre of the tile's first pixel.
    """

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        block = Block(lanes.literal_value, context, builder)
        state, params_data = block.data(sig.args[3], args[3]), block.data(sig.args[5], args[5])
        wanted = depth.literal_value, absolute.literal_value
        totals = [State(block, 0.0) for _ in range(sum_count(*wanted))]

        def process_block(number: Any) -> None:
            left, top = first_pixel(block, number, args[7], args[8])
            rays = evaluate_rays(block, params_data, args[6], left, top)
            at = builder.mul(number, block.index(block.lanes), flags=("nuw", "nsw"))
            for which, value in _sums_of_block(block, state, at, rays, *wanted):
                totals[which].set(totals[which].get() + value)

        block.each_bit(args[4], process_block)
        for number, total in enumerate(block.totals([total.get() for total in totals])):
            block.store(total, state, block.offset(args[9], number * block.lanes))
        return context.get_dummy_value()

    index, single = types.intp, types.float32
    signature = types.void(
        lanes, depth, absolute, m, types.uint64, params, index, single, single, index
    )
    return signature, generate
