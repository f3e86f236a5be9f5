# SPDX-License-Identifier: GPL-3.0-or-later
"""Vector code that blends all Gaussians of a block of pixels, with the block's state in registers.

For the depth, each Gaussian that can matter leaves an entry in the block's list: one that any pixel
meets before its transmittance has crossed 0.5, or whose front reaches back before the deepest peak
in front of that crossing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from ...kernels.compiled import inline
from ..isosurface.isosurface_steps import (
    LIST_VALUES,
    NEGLIGIBLE,
    Crossing,
    entry_place,
    start_solver,
)
from ..simd import raster_math as constants
from ..simd.raster_math import (
    ALPHA_MIN,
    BEST,
    BEST_AT,
    F0,
    FEATURES,
    STRIDE,
    TRANSMITTANCE,
    TRANSMITTANCE_MIN,
)
from ..simd.simd import Block, Mask, State, Vector
from ..simd.simd_math import Sight, first_pixel, peak_depth, see

_COLOR_COLUMN, _SHARPNESS_COLUMN = 13, 12


class _DepthRecord:
    """What blending keeps for the depth: the list of entries and where 0.5 was crossed."""

    def __init__(self, block: Block, lists: Any) -> None:
        self.block, self.lists = block, lists
        self.count = cgutils.alloca_once_value(block.builder, block.index(0))
        self.high, self.sharpest = State(block, 0.0), State(block, 0.0)
        # Transmittance before, then the entry, of the Gaussian at the crossing.
        self.crossing = [State(block, 0.0) for _ in range(1 + LIST_VALUES)]

    def sharpen(self, sight: Sight, contributes: Mask) -> Vector:
        """Note and return a Gaussian's sharpness along the rays."""
        sharpness = sight.den * sight.row[_SHARPNESS_COLUMN]
        known = self.sharpest.get()
        self.sharpest.set((contributes & (sharpness > known)).choose(sharpness, known))
        return sharpness

    def add_before(self, sight: Sight, contributes: Mask, before: Vector, after: Vector) -> None:
        """Note a Gaussian while some pixel has not crossed 0.5."""
        peak, sharpness = peak_depth(sight), self.sharpen(sight, contributes)
        above = before > constants.ISO_LEVEL
        high = self.high.get()
        self.high.set((contributes & above & (peak > high)).choose(peak, high))
        values = contributes.choose(sight.raw, 0.0), peak, sharpness
        crosses = above & (after <= constants.ISO_LEVEL)
        for kept, value in zip(self.crossing, (before, *values), strict=True):
            kept.set(crosses.choose(value, kept.get()))
        self._append(values, contributes)

    def add_behind(self, sight: Sight, contributes: Mask) -> None:
        """Note a Gaussian behind all crossings, if its front reaches back to the brackets."""
        peak, sharpness = peak_depth(sight), self.sharpen(sight, contributes)
        behind = (peak - self.high.get()).max(0.0)
        matters = contributes & (sharpness * behind * behind < NEGLIGIBLE)
        self._append((contributes.choose(sight.raw, 0.0), peak, sharpness), matters)

    def _append(self, values: tuple[Vector, ...], matters: Mask) -> None:
        block, builder = self.block, self.block.builder
        count = builder.load(self.count)
        place = entry_place(block, count)
        for column, value in enumerate(values):
            block.store(value, self.lists, block.offset(place, column * block.lanes))
        builder.store(builder.add(count, builder.zext(matters.any(), count.type)), self.count)


@dataclass(frozen=True)
class _Weights:
    """Where blending gathers weights: per pair, and the strongest Gaussian of each pixel."""

    pair_weights: Any
    pair_slots: Any
    begin: Any
    best: State
    best_at: State

    def add(self, block: Block, weight: Vector, pair: Any) -> None:
        """Note the weights of one pair in one block."""
        builder = block.builder
        best = self.best.get()
        stronger = weight > best
        self.best.set(stronger.choose(weight, best))
        number = builder.sitofp(builder.sub(pair, self.begin), ir.FloatType())
        self.best_at.set(stronger.choose(block.splat(number), self.best_at.get()))
        slot = builder.sext(
            builder.load(builder.gep(self.pair_slots, [pair], inbounds=True)), pair.type
        )
        total = builder.gep(self.pair_weights, [builder.mul(slot, block.index(2))], inbounds=True)
        largest = builder.gep(total, [block.index(1)], inbounds=True)
        builder.store(builder.fadd(builder.load(total), weight.total()), total)
        now, before = weight.largest(), builder.load(largest)
        more = builder.fcmp_ordered(">", now, before)
        builder.store(builder.select(more, now, before), largest)


def _blend_intrinsic(lanes: int, depth: bool, weights: bool) -> Any:
    @intrinsic
    def blend(  # type: ignore[no-untyped-def]
        typingctx, m, number, params, gaussian_ids, pair_slots, visits, first, count, begin, x, y,
        lists, fronts, limit, pair_weights,
    ):  # fmt: skip
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            block = Block(lanes, context, builder)
            m_data, params_data, ids, slots, list_of_visits, entries, front_data, sums = (
                block.data(sig.args[place], args[place]) for place in (0, 2, 3, 4, 5, 11, 12, 14)
            )
            number_, first_, count_, begin_, x_, y_, limit_ = (
                args[place] for place in (1, 6, 7, 8, 9, 10, 13)
            )
            left, top = first_pixel(block, number_, x_, y_)
            planes = builder.mul(number_, block.index(lanes), flags=("nuw", "nsw"))

            def plane(which: int) -> Any:
                return block.offset(planes, which * STRIDE)

            def pair_of(n: Any) -> Any:
                place = builder.gep(list_of_visits, [builder.add(first_, n)], inbounds=True)
                return builder.sext(builder.load(place), first_.type)

            light = State(block, block.load(m_data, plane(TRANSMITTANCE)))
            features = [State(block, 0.0) for _ in range(FEATURES)]
            gathered = (
                _Weights(sums, slots, begin_, State(block, 0.0), State(block, 0.0))
                if weights
                else None
            )

            def visit(n: Any) -> tuple[Sight, Mask, Vector, Vector]:
                """Blend one Gaussian; return also the light before and behind it."""
                pair = pair_of(n)
                which = builder.load(builder.gep(ids, [pair], inbounds=True))
                sight = see(block, params_data, builder.sext(which, pair.type), left, top)
                before = light.get()
                contributes = (sight.alpha >= float(ALPHA_MIN)) & (
                    before >= float(TRANSMITTANCE_MIN)
                )
                weight = contributes.choose(sight.alpha.times(before), 0.0)
                after = before - weight
                light.set(after)
                for feature, state in enumerate(features):
                    state.set(state.get() + weight * sight.row[_COLOR_COLUMN + feature])
                if gathered is not None:
                    gathered.add(block, weight, pair)
                return sight, contributes, before, after

            always = ir.Constant(ir.IntType(1), 1)
            place = cgutils.alloca_once_value(builder, block.index(0))
            record = _DepthRecord(block, entries) if depth else None
            if record is not None:

                def cross(n: Any) -> Any:
                    sight, contributes, before, after = visit(n)
                    record.add_before(sight, contributes, before, after)
                    return (after > constants.ISO_LEVEL).any()

                def trail(n: Any) -> Any:
                    sight, contributes, _, _ = visit(n)
                    record.add_behind(sight, contributes)
                    return always

                block.walk(place, count_, cross, lambda n: always)
                # No front of the pairs that come reaches back to the last bracket: record no more.
                deepest = record.high.get().largest()

                def reaches_back(n: Any) -> Any:
                    offset = builder.sub(pair_of(n), begin_)
                    front = builder.load(builder.gep(front_data, [offset], inbounds=True))
                    return builder.fcmp_ordered("<", front, deepest)

                block.walk(place, count_, trail, reaches_back)

            def finish(n: Any) -> Any:
                _, _, _, after = visit(n)
                return (after >= float(TRANSMITTANCE_MIN)).any()

            block.walk(place, count_, finish, lambda n: always)
            block.store(light.get(), m_data, plane(TRANSMITTANCE))
            for feature, state in enumerate(features):
                block.store(state.get(), m_data, plane(F0 + feature))
            if gathered is not None:
                block.store(gathered.best.get(), m_data, plane(BEST))
                block.store(gathered.best_at.get(), m_data, plane(BEST_AT))
            if record is None:
                return block.index(0)
            before, alpha, peak, sharpness = (kept.get() for kept in record.crossing)
            crossing = Crossing(before, alpha, peak, sharpness, light.get(), record.high.get())
            nearest = builder.load(front_data)
            opened = start_solver(block, m_data, crossing, record.sharpest.get(), nearest, limit_)
            # Nobody open, nothing to solve: no entries.
            nobody = builder.icmp_unsigned("==", opened, block.index(0))
            return builder.select(nobody, block.index(0), builder.load(record.count))

        index, single = types.intp, types.float32
        signature = types.intp(
            m, index, params, gaussian_ids, pair_slots, visits, index, index, index, single, single,
            lists, fronts, single, pair_weights,
        )  # fmt: skip
        return signature, generate

    return blend


_plain_16 = _blend_intrinsic(16, False, False)
_depth_16 = _blend_intrinsic(16, True, False)
_weights_16 = _blend_intrinsic(16, False, True)
_both_16 = _blend_intrinsic(16, True, True)
_plain_8 = _blend_intrinsic(8, False, False)
_depth_8 = _blend_intrinsic(8, True, False)
_weights_8 = _blend_intrinsic(8, False, True)
_both_8 = _blend_intrinsic(8, True, True)


@inline
def blend_block(
    lanes: Any, depth: Any, weights: Any, m: Any, block: Any, params: Any, ids: Any, slots: Any,
    visits: Any, first: Any, count: Any, begin: Any, x: Any, y: Any, lists: Any, fronts: Any,
    limit: Any, pair_weights: Any,
) -> Any:  # fmt: skip
    """Blend the pairs ``visits[first .. first + count]`` into a block; return its list's length.

    Parameters
    ----------
    lanes : int
    depth, weights : bool
        Write the list and begin to solve it; gather blending weights.
    m : (n,) float32
        The tile's scratch.
    block : int
    begin : int
        First pair of the tile; places of the strongest Gaussians count from it.
    x, y : float32
        Centre of the tile's first pixel, pixels.
    lists : (n,) float32
        Receives the entries.
    fronts : (n,) float32
        For each pair of the tile, the nearest z-depth that it or a later one reaches back to.
    limit : float32
        Largest final transmittance of a pixel that has a depth.
    """
    if lanes == 16:
        if depth:
            if weights:
                return _both_16(
                    m, block, params, ids, slots, visits, first, count, begin, x, y, lists, fronts,
                    limit, pair_weights,
                )  # fmt: skip
            return _depth_16(
                m, block, params, ids, slots, visits, first, count, begin, x, y, lists, fronts,
                limit, pair_weights,
            )  # fmt: skip
        if weights:
            return _weights_16(
                m, block, params, ids, slots, visits, first, count, begin, x, y, lists, fronts,
                limit, pair_weights,
            )  # fmt: skip
        return _plain_16(
            m, block, params, ids, slots, visits, first, count, begin, x, y, lists, fronts,
            limit, pair_weights,
        )  # fmt: skip
    if depth:
        if weights:
            return _both_8(
                m, block, params, ids, slots, visits, first, count, begin, x, y, lists, fronts,
                limit, pair_weights,
            )  # fmt: skip
        return _depth_8(
            m, block, params, ids, slots, visits, first, count, begin, x, y, lists, fronts,
            limit, pair_weights,
        )  # fmt: skip
    if weights:
        return _weights_8(
            m, block, params, ids, slots, visits, first, count, begin, x, y, lists, fronts,
            limit, pair_weights,
        )  # fmt: skip
    return _plain_8(
        m, block, params, ids, slots, visits, first, count, begin, x, y, lists, fronts,
        limit, pair_weights,
    )  # fmt: skip
