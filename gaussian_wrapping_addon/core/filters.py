# SPDX-License-Identifier: GPL-3.0-or-later
"""Separable filters and trilinear grids: kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.errors import RequireLiteralValue
from numba.extending import intrinsic

from .compiled import inline

# -- Image pyramids stored in one array, and trilinear interpolation for kernels ------------------


MAX_LEVELS = 8


@dataclass(frozen=True)
class Pyramid:
    """Image levels in one flat array, each half the size of the previous one."""

    pixels: np.ndarray  # (n, 3) uint8 pixels of all levels, row by row
    levels: np.ndarray  # (levels, 3) int64: first pixel, width, height


def pyramid(image: np.ndarray) -> Pyramid:
    """Build a pyramid of an image (h, w, 3) uint8 by averaging 2 x 2 pixels.

    It ends at one pixel, or after :data:`MAX_LEVELS`. Odd borders are repeated, so scales are
    exact.
    """
    parts, levels, begin = [], [], 0
    current = image
    while True:
        height, width = current.shape[:2]
        parts.append(current.reshape(-1, 3))
        levels.append((begin, width, height))
        begin += width * height
        if len(levels) >= MAX_LEVELS or max(width, height) == 1:
            break
        even = np.pad(current, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        total = even[0::2, 0::2].astype(np.uint16) + even[1::2, 0::2]
        total += even[0::2, 1::2]
        total += even[1::2, 1::2]
        current = ((total + 2) >> 2).astype(np.uint8)
    return Pyramid(np.concatenate(parts), np.array(levels, np.int64))


@inline
def bilinear(
    pixels: Any, begin: int, width: int, height: int, x: float, y: float
) -> tuple[float, float, float]:
    """Interpolate three channels at pixel coordinates (centres at + 0.5), clamped at the border."""
    fx = min(max(x - 0.5, 0.0), width - 1.0)
    fy = min(max(y - 0.5, 0.0), height - 1.0)
    ix, iy = int(fx), int(fy)
    jx, jy = min(ix + 1, width - 1), min(iy + 1, height - 1)
    tx, ty = fx - ix, fy - iy
    a, b = begin + iy * width + ix, begin + iy * width + jx
    c, d = begin + jy * width + ix, begin + jy * width + jx
    wa, wb = (1.0 - tx) * (1.0 - ty), tx * (1.0 - ty)
    wc, wd = (1.0 - tx) * ty, tx * ty
    red = wa * pixels[a, 0] + wb * pixels[b, 0] + wc * pixels[c, 0] + wd * pixels[d, 0]
    green = wa * pixels[a, 1] + wb * pixels[b, 1] + wc * pixels[c, 1] + wd * pixels[d, 1]
    blue = wa * pixels[a, 2] + wb * pixels[b, 2] + wc * pixels[c, 2] + wd * pixels[d, 2]
    return red, green, blue


@inline
def trilinear(
    pixels: Any, levels: Any, level: float, x: float, y: float
) -> tuple[float, float, float]:
    """Interpolate between two levels; x and y are pixel coordinates of level 0."""
    top = len(levels) - 1
    clamped = min(max(level, 0.0), float(top))
    low = min(int(clamped), top)
    share = clamped - low
    scale = 1.0 / (1 << low)
    red, green, blue = bilinear(
        pixels, levels[low, 0], levels[low, 1], levels[low, 2], x * scale, y * scale
    )
    if share > 0.0 and low < top:
        half = 0.5 * scale
        red2, green2, blue2 = bilinear(
            pixels, levels[low + 1, 0], levels[low + 1, 1], levels[low + 1, 2], x * half, y * half
        )
        red += share * (red2 - red)
        green += share * (green2 - green)
        blue += share * (blue2 - blue)
    return red, green, blue


# -- Vectorised separable filters for the SSIM window ---------------------------------------------
#
# Indices are not checked: a run reads and writes :data:`LANES` neighbouring values. Weights are
# passed as a tuple so that they stay in registers: a loop over an array would reload them for
# each run, as LLVM cannot prove that the target is another array.


LANES = 16  # Values per run. LLVM splits a run into as many registers as needed.
TAPS = 11
HALF = TAPS // 2 + 1
RING = TAPS + 1
"""Rows covered by two neighbouring windows."""

_WORD = ir.IntType(32)


class _Runs:
    """Emits loads, sums and stores of runs within one function."""

    def __init__(self, context: Any, builder: Any, kind: Any) -> None:
        self.context, self.builder = context, builder
        self.number = context.get_value_type(kind)
        self.vector = ir.VectorType(self.number, LANES)
        self.align = self.number.get_abi_size(context.target_data)

    def pointer(self, array_type: Any, array: Any, at: Any) -> Any:
        data = self.context.make_array(array_type)(self.context, self.builder, array).data
        return self.builder.bitcast(self.builder.gep(data, [at]), self.vector.as_pointer())

    def splat(self, value: Any) -> Any:
        nothing = ir.Constant(self.vector, ir.Undefined)
        first = self.builder.insert_element(nothing, value, ir.Constant(_WORD, 0))
        lanes = ir.Constant(ir.VectorType(_WORD, LANES), [0] * LANES)
        return self.builder.shuffle_vector(first, nothing, lanes)

    def tap_index(self, at: Any, step: Any, count: int) -> Any:
        return self.builder.add(at, self.builder.mul(step, ir.Constant(step.type, count)))

    def load(self, array_type: Any, array: Any, at: Any) -> Any:
        return self.builder.load(self.pointer(array_type, array, at), align=self.align)

    def weighted(self, weights: list[Any], runs: list[Any]) -> Any:
        """Return the sum of 11 runs with symmetric weights, of which the first six are given."""
        b, total = self.builder, None
        for tap, weight in enumerate(weights):
            mirrored = len(runs) - 1 - tap
            run = runs[tap]
            if mirrored > tap:
                run = b.fadd(run, runs[mirrored])
            part = b.fmul(weight, run, flags=("contract",))
            total = part if total is None else b.fadd(total, part, flags=("contract",))
        return total

    def store(self, run: Any, array_type: Any, array: Any, at: Any) -> None:
        self.builder.store(run, self.pointer(array_type, array, at), align=self.align)


@intrinsic
def filter_run(typingctx, target, target_at, source, source_at, step, weights):  # type: ignore[no-untyped-def]
    """``target[target_at + j] = sum_k weights[k] source[source_at + k step + j]``, 0 <= k < 11.

    ``weights``: the first six; the others mirror them.
    """

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        runs = _Runs(context, builder, sig.args[0].dtype)
        taps = [runs.splat(builder.extract_value(args[5], tap)) for tap in range(HALF)]
        indices = [runs.tap_index(args[3], args[4], tap) for tap in range(TAPS)]
        loaded = [runs.load(sig.args[2], args[2], tap_index) for tap_index in indices]
        runs.store(runs.weighted(taps, loaded), sig.args[0], args[0], args[1])
        return context.get_dummy_value()

    tuples = types.UniTuple(source.dtype, HALF)
    return types.void(target, types.intp, source, types.intp, types.intp, tuples), generate


@intrinsic
def filter_two_runs(  # type: ignore[no-untyped-def]
    typingctx, target, target_at, apart, source, source_at, step, weights, first
):
    """Filter a ring of 12 rows for two windows that start in neighbouring rows, loading it once.

    ``first``: the slot of the first window's first row, a constant, so that all 12 addresses are
    one register plus constants. The second window's result is written to ``target_at + apart``.
    """
    if not isinstance(first, types.IntegerLiteral):
        raise RequireLiteralValue("the first slot is no constant")
    slots = [(first.literal_value + k) % RING for k in range(RING)]

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        runs = _Runs(context, builder, sig.args[0].dtype)
        taps = [runs.splat(builder.extract_value(args[6], tap)) for tap in range(HALF)]
        indices = [runs.tap_index(args[4], args[5], slot) for slot in slots]
        loaded = [runs.load(sig.args[3], args[3], tap_index) for tap_index in indices]
        upper, lower = runs.weighted(taps, loaded[:TAPS]), runs.weighted(taps, loaded[1:])
        runs.store(upper, sig.args[0], args[0], args[1])
        runs.store(lower, sig.args[0], args[0], builder.add(args[1], args[2]))
        return context.get_dummy_value()

    tuples = types.UniTuple(source.dtype, HALF)
    index = types.intp
    return types.void(target, index, index, source, index, index, tuples, first), generate
