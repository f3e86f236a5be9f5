# SPDX-License-Identifier: GPL-3.0-or-later
"""Vector code of the forward pass: blends all Gaussians of a block of pixels in registers.

For the depth, each Gaussian that can affect it is appended to the block's list: those met before
the transmittance of some pixel has crossed 0.5, and those whose density reaches back in front of
the deepest peak before that crossing.
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
    entry_index,
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
from ..simd.simd_math import RayEvaluation, evaluate_rays, first_pixel, peak_depth

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


def _blend_intrinsic(lanes: int, depth: bool, weights: bool) -> Any:
    @intrinsic
    def blend(  # type: ignore[no-untyped-def]
        typingctx, m, number, params, gaussian_ids, intersection_slots, contributors, first, count,
        begin, x, y, lists, nearest_depths, limit, intersection_weights,
    ):  # fmt: skip
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            block = Block(lanes, context, builder)
            m_data, params_data, ids, slots, contributor_list, entries, nearest_data, sums = (
                block.data(sig.args[k], args[k]) for k in (0, 2, 3, 4, 5, 11, 12, 14)
            )
            number_, first_, count_, begin_, x_, y_, limit_ = (
                args[k] for k in (1, 6, 7, 8, 9, 10, 13)
            )
            left, top = first_pixel(block, number_, x_, y_)
            planes = builder.mul(number_, block.index(lanes), flags=("nuw", "nsw"))

            def plane(which: int) -> Any:
                return block.offset(planes, which * STRIDE)

            def contributor_at(n: Any) -> Any:
                pointer = builder.gep(contributor_list, [builder.add(first_, n)], inbounds=True)
                return builder.sext(builder.load(pointer), first_.type)

            transmittance = State(block, block.load(m_data, plane(TRANSMITTANCE)))
            features = [State(block, 0.0) for _ in range(FEATURES)]
            gathered = (
                _Weights(sums, slots, begin_, State(block, 0.0), State(block, 0.0))
                if weights
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
                contributes = (rays.alpha >= float(ALPHA_MIN)) & (
                    before >= float(TRANSMITTANCE_MIN)
                )
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
            record = _DepthRecord(block, entries) if depth else None
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
            crossing = Crossing(
                before, alpha, peak, sharpness, transmittance.get(), record.high.get()
            )
            nearest = builder.load(nearest_data)
            opened = start_solver(block, m_data, crossing, record.sharpest.get(), nearest, limit_)
            # Without a pixel to solve there are no entries.
            none_open = builder.icmp_unsigned("==", opened, block.index(0))
            return builder.select(none_open, block.index(0), builder.load(record.count))

        index, single = types.intp, types.float32
        signature = types.intp(
            m, index, params, gaussian_ids, intersection_slots, contributors, index, index,
            index, single, single, lists, nearest_depths, single, intersection_weights,
        )  # fmt: skip
        return signature, generate

    return blend


_base_16 = _blend_intrinsic(16, False, False)
_depth_16 = _blend_intrinsic(16, True, False)
_weights_16 = _blend_intrinsic(16, False, True)
_both_16 = _blend_intrinsic(16, True, True)
_base_8 = _blend_intrinsic(8, False, False)
_depth_8 = _blend_intrinsic(8, True, False)
_weights_8 = _blend_intrinsic(8, False, True)
_both_8 = _blend_intrinsic(8, True, True)


@inline
def blend_block(
    lanes: Any, depth: Any, weights: Any, m: Any, block: Any, params: Any, ids: Any, slots: Any,
    contributors: Any, first: Any, count: Any, begin: Any, x: Any, y: Any, lists: Any,
    nearest_depths: Any, limit: Any, intersection_weights: Any,
) -> Any:  # fmt: skip
    """Blend ``contributors[first .. first + count]`` into a block; return its list's length.

    Parameters
    ----------
    lanes : int
    depth, weights : bool
        Write the list and initialise the solver; collect blending weights.
    m : (n,) float32
        The tile's scratch.
    block : int
    begin : int
        First intersection of the tile; indices of the strongest Gaussians are relative to it.
    x, y : float32
        Centre of the tile's first pixel, pixels.
    lists : (n,) float32
        Receives the entries.
    nearest_depths : (n,) float32
        For each intersection of the tile, the nearest z-depth that it or a later one reaches.
    limit : float32
        Largest final transmittance of a pixel that has a depth.
    """
    if lanes == 16:
        if depth:
            if weights:
                return _both_16(
                    m, block, params, ids, slots, contributors, first, count, begin, x, y, lists,
                    nearest_depths, limit, intersection_weights,
                )  # fmt: skip
            return _depth_16(
                m, block, params, ids, slots, contributors, first, count, begin, x, y, lists,
                nearest_depths, limit, intersection_weights,
            )  # fmt: skip
        if weights:
            return _weights_16(
                m, block, params, ids, slots, contributors, first, count, begin, x, y, lists,
                nearest_depths, limit, intersection_weights,
            )  # fmt: skip
        return _base_16(
            m, block, params, ids, slots, contributors, first, count, begin, x, y, lists,
            nearest_depths, limit, intersection_weights,
        )  # fmt: skip
    if depth:
        if weights:
            return _both_8(
                m, block, params, ids, slots, contributors, first, count, begin, x, y, lists,
                nearest_depths, limit, intersection_weights,
            )  # fmt: skip
        return _depth_8(
            m, block, params, ids, slots, contributors, first, count, begin, x, y, lists,
            nearest_depths, limit, intersection_weights,
        )  # fmt: skip
    if weights:
        return _weights_8(
            m, block, params, ids, slots, contributors, first, count, begin, x, y, lists,
            nearest_depths, limit, intersection_weights,
        )  # fmt: skip
    return _base_8(
        m, block, params, ids, slots, contributors, first, count, begin, x, y, lists,
        nearest_depths, limit, intersection_weights,
    )  # fmt: skip
