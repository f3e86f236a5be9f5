# SPDX-License-Identifier: GPL-3.0-or-later
"""Explicit 8- and 16-lane float32 vectors in numba kernels."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import llvmlite.binding
import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from .. import limits
from ..compiled import inline

# -- Explicit SIMD vectors of 8 or 16 float32 in numba kernels, with arithmetic operators ---------
#
# The bodies of numba *intrinsics* are written with operators on :class:`Vector`, which emit LLVM
# IR. Unlike a loop, which LLVM may fail to vectorise if it cannot rule out overlapping memory,
# this code is always packed, keeps its state in registers across its own loops, and compiles to
# the same instructions wherever it is used. Bounds are not checked.


# No reassociation: the same expression then rounds alike in the forward and the backward kernel.
_FLAGS = ("nnan", "ninf", "nsz", "contract")
_QUOTIENT_FLAGS = (*_FLAGS, "arcp", "afn", "reassoc")
_FLOAT = ir.FloatType()
_WORD = ir.IntType(32)
_INDEX = ir.IntType(64)
_SQRT_HALF_BITS = 0x3F3504F3
"""float32 sqrt(0.5): logarithms use mantissas between this and twice this."""


class Vector:
    """One SSA value of ``lanes`` float32; operands may be vectors or Python numbers."""

    __slots__ = ("block", "value")

    def __init__(self, block: Block, value: Any) -> None:
        self.block, self.value = block, value

    def _binary(self, name: str, other: Vector | float, *, swapped: bool = False) -> Vector:
        a, b = self.value, self.block.vector(other).value
        emit = getattr(self.block.builder, name)
        flags = _QUOTIENT_FLAGS if name == "fdiv" else _FLAGS
        return Vector(self.block, emit(b, a, flags=flags) if swapped else emit(a, b, flags=flags))

    def __add__(self, other: Vector | float) -> Vector:
        return self._binary("fadd", other)

    __radd__ = __add__

    def __sub__(self, other: Vector | float) -> Vector:
        return self._binary("fsub", other)

    def __rsub__(self, other: float) -> Vector:
        return self._binary("fsub", other, swapped=True)

    def __mul__(self, other: Vector | float) -> Vector:
        return self._binary("fmul", other)

    __rmul__ = __mul__

    def __truediv__(self, other: Vector | float) -> Vector:
        return self._binary("fdiv", other)

    def __rtruediv__(self, other: float) -> Vector:
        return self._binary("fdiv", other, swapped=True)

    def __neg__(self) -> Vector:
        return 0.0 - self

    def _compare(self, relation: str, other: Vector | float) -> Mask:
        value = self.block.builder.fcmp_ordered(
            relation, self.value, self.block.vector(other).value, flags=("nnan",)
        )
        return Mask(self.block, value)

    def __lt__(self, other: Vector | float) -> Mask:
        return self._compare("<", other)

    def __le__(self, other: Vector | float) -> Mask:
        return self._compare("<=", other)

    def __gt__(self, other: Vector | float) -> Mask:
        return self._compare(">", other)

    def __ge__(self, other: Vector | float) -> Mask:
        return self._compare(">=", other)

    def max(self, other: Vector | float) -> Vector:
        """Return the larger value of each lane."""
        return (self > other).select(self, other)

    def min(self, other: Vector | float) -> Vector:
        """Return the smaller value of each lane."""
        return (self < other).select(self, other)

    def times(self, other: Vector) -> Vector:
        """Return the product, rounded before anything is added to it."""
        return Vector(self.block, self.block.builder.fmul(self.value, other.value))

    def reciprocal(self) -> Vector:
        """Return 1 over each lane, correctly rounded; ``/`` may be two roundings off."""
        one = self.block.vector(1.0).value
        return Vector(self.block, self.block.builder.fdiv(one, self.value))

    def sqrt(self) -> Vector:
        """Return the square root of each lane, correctly rounded."""
        return Vector(self.block, self.block.call("llvm.sqrt", [self.value], flags=()))

    def abs(self) -> Vector:
        """Return the absolute value of each lane."""
        return Vector(self.block, self.block.call("llvm.fabs", [self.value], flags=()))

    def log(self) -> Vector:
        """Return the natural logarithm of positive normal numbers (absolute error 2e-7)."""
        block, builder = self.block, self.block.builder
        words = ir.VectorType(_WORD, block.lanes)

        def every(value: int) -> Any:
            return ir.Constant(words, [ir.Constant(_WORD, value)] * block.lanes)

        bits = builder.bitcast(self.value, words)
        exponent = builder.ashr(builder.sub(bits, every(_SQRT_HALF_BITS)), every(23))
        mantissa = builder.sub(bits, builder.shl(exponent, every(23)))
        power = Vector(block, builder.sitofp(exponent, block.kind))
        excess = Vector(block, builder.bitcast(mantissa, block.kind)) - 1.0
        ratio = excess / (excess + 2.0)
        square = ratio * ratio
        series = ((square * (2 / 9) + 2 / 7) * square + 2 / 5) * square + 2 / 3
        return power * math.log(2.0) + (series * square + 2.0) * ratio

    def largest(self) -> Any:
        """Return the largest lane as a scalar."""
        return self.block.reduce("fmax", [self.value])

    def total(self) -> Any:
        """Return the sum of the lanes as a scalar."""
        return self.block.reduce("fadd", [ir.Constant(_FLOAT, 0.0), self.value])


class Mask:
    """One boolean per lane."""

    __slots__ = ("block", "value")

    def __init__(self, block: Block, value: Any) -> None:
        self.block, self.value = block, value

    def __and__(self, other: Mask) -> Mask:
        return Mask(self.block, self.block.builder.and_(self.value, other.value))

    def __or__(self, other: Mask) -> Mask:
        return Mask(self.block, self.block.builder.or_(self.value, other.value))

    def __invert__(self) -> Mask:
        return Mask(self.block, self.block.builder.not_(self.value))

    def select(self, yes: Vector | float, no: Vector | float) -> Vector:
        """Return ``yes`` where true, ``no`` elsewhere."""
        block = self.block
        a, b = block.vector(yes).value, block.vector(no).value
        return Vector(block, block.builder.select(self.value, a, b))

    def any(self) -> Any:
        """Return whether any lane is true, as an SSA boolean."""
        return self.block.builder.icmp_unsigned("!=", self.bits(), self.block.index(0))

    def bits(self) -> Any:
        """Return the lanes as the bits of a 64-bit integer."""
        builder = self.block.builder
        word = builder.bitcast(self.value, ir.IntType(self.block.lanes))
        return builder.zext(word, _INDEX)


class State:
    """A vector that stays in registers across the iterations of a loop."""

    def __init__(self, block: Block, start: Vector | float) -> None:
        self.block = block
        self._slot = cgutils.alloca_once(block.builder, block.kind)
        self.set(start)

    def get(self) -> Vector:
        """Return the current value."""
        return Vector(self.block, self.block.builder.load(self._slot))

    def set(self, value: Vector | float) -> None:
        """Replace the current value."""
        self.block.builder.store(self.block.vector(value).value, self._slot)


def shuffle(builder: Any, a: Any, b: Any, order: Sequence[int]) -> Any:
    """Return the SSA vector of the lanes ``order`` of two vectors in a row."""
    indices = ir.Constant(ir.VectorType(_WORD, len(order)), [ir.Constant(_WORD, k) for k in order])
    return builder.shuffle_vector(a, b, indices)


class Block:
    """Emits vector code of one width, 8 or 16 lanes, into a numba intrinsic.

    ``context`` and ``builder`` are the arguments of the intrinsic's code generator.
    """

    def __init__(self, lanes: int, context: Any, builder: Any) -> None:
        self.lanes, self.context, self.builder = lanes, context, builder
        self.kind = ir.VectorType(_FLOAT, lanes)

    def vector(self, value: Vector | float) -> Vector:
        """Return a vector; a number is broadcast to all lanes."""
        if isinstance(value, Vector):
            return value
        return self.constants([value] * self.lanes)

    def constants(self, values: Sequence[float]) -> Vector:
        """Return a constant vector, one number per lane."""
        numbers = [ir.Constant(_FLOAT, float(value)) for value in values]
        return Vector(self, ir.Constant(self.kind, numbers))

    def splat(self, scalar: Any) -> Vector:
        """Broadcast an SSA float32 to all lanes."""
        zero = ir.Constant(_WORD, 0)
        one = self.builder.insert_element(ir.Constant(self.kind, ir.Undefined), scalar, zero)
        order = ir.Constant(ir.VectorType(_WORD, self.lanes), None)
        return Vector(self, self.builder.shuffle_vector(one, one, order))

    def data(self, kind: Any, array: Any) -> Any:
        """Return the pointer to the first value of a numba array argument."""
        return self.context.make_array(kind)(self.context, self.builder, array).data

    def index(self, value: int) -> Any:
        """Return an SSA index."""
        return ir.Constant(_INDEX, value)

    def offset(self, base: Any, *terms: Any) -> Any:
        """Return ``base`` plus SSA indices or Python ints."""
        for term in terms:
            step = self.index(term) if isinstance(term, int) else term
            base = self.builder.add(base, step, flags=("nuw", "nsw"))
        return base

    def _run(self, data: Any, at: Any) -> Any:
        pointer = self.builder.gep(data, [at], inbounds=True)
        return self.builder.bitcast(pointer, self.kind.as_pointer())

    def load(self, data: Any, at: Any) -> Vector:
        """Return the vector at ``data[at]``."""
        return Vector(self, self.builder.load(self._run(data, at), align=4))

    def store(self, value: Vector | float, data: Any, at: Any) -> None:
        """Write a vector to ``data[at]``."""
        self.builder.store(self.vector(value).value, self._run(data, at), align=4)

    def scalar(self, data: Any, at: Any) -> Any:
        """Return the single float32 at ``data[at]``."""
        return self.builder.load(self.builder.gep(data, [at], inbounds=True), align=4)

    def call(self, name: str, values: list[Any], flags: tuple[str, ...] = _FLAGS) -> Any:
        """Call an LLVM intrinsic of this vector type."""
        kind = ir.FunctionType(self.kind, [value.type for value in values])
        function = cgutils.get_or_insert_function(
            self.builder.module, kind, f"{name}.v{self.lanes}f32"
        )
        return self.builder.call(function, values, fastmath=flags)

    def reduce(self, operation: str, values: list[Any]) -> Any:
        """Reduce a vector to a scalar."""
        kind = ir.FunctionType(_FLOAT, [value.type for value in values])
        name = f"llvm.vector.reduce.{operation}.v{self.lanes}f32"
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)
        return self.builder.call(function, values, fastmath=("nnan", "nsz", "reassoc"))

    def totals(self, vectors: Sequence[Vector]) -> list[Vector]:
        """Return the sums over lanes of many vectors, ``lanes`` of them in each result.

        Two vectors are folded into one by repeatedly adding halves of their groups of lanes: a
        third of the instructions of reducing one by one.
        """
        lanes = self.lanes
        missing = -len(vectors) % lanes
        level = [*vectors, *([self.vector(0.0)] * missing)]
        group = lanes
        while group > 1:
            half = group // 2
            first = [g + k for g in range(0, 2 * lanes, group) for k in range(half)]
            second = [k + half for k in first]
            level = [
                Vector(self, shuffle(self.builder, a.value, b.value, first))
                + Vector(self, shuffle(self.builder, a.value, b.value, second))
                for a, b in zip(level[::2], level[1::2], strict=True)
            ]
            group = half
        return level

    def walk(
        self, cursor: Any, count: Any, body: Callable[[Any], Any], test: Callable[[Any], Any]
    ) -> None:
        """Run ``body`` from the index stored in ``cursor`` up to ``count``, while it returns true.

        ``cursor`` is advanced past the last iteration, so that another loop can continue from
        there. ``test`` is evaluated before each iteration; both return an SSA boolean.
        """
        builder = self.builder
        head, probe, turn, end = (
            builder.append_basic_block(name) for name in ("walk", "test", "turn", "walk.end")
        )
        builder.branch(head)
        builder.position_at_end(head)
        index = builder.load(cursor)
        builder.cbranch(builder.icmp_signed("<", index, count), probe, end)
        builder.position_at_end(probe)
        builder.cbranch(test(index), turn, end)
        builder.position_at_end(turn)
        builder.store(builder.add(index, self.index(1)), cursor)
        builder.cbranch(body(index), head, end)
        builder.position_at_end(end)

    def each_bit(self, bits: Any, body: Callable[[Any], None]) -> None:
        """Run ``body(bit)`` for each set bit of an SSA 64-bit integer, lowest first."""
        builder = self.builder
        left = cgutils.alloca_once_value(builder, bits)
        head = builder.append_basic_block("bits")
        turn = builder.append_basic_block("bit")
        end = builder.append_basic_block("bits.end")
        builder.branch(head)
        builder.position_at_end(head)
        current = builder.load(left)
        builder.cbranch(builder.icmp_unsigned("!=", current, self.index(0)), turn, end)
        builder.position_at_end(turn)
        body(builder.cttz(current, ir.Constant(ir.IntType(1), 1)))
        builder.store(builder.and_(current, builder.sub(current, self.index(1))), left)
        builder.branch(head)
        builder.position_at_end(end)

    def repeat(self, count: Any, body: Callable[[Any], Mask | None]) -> None:
        """Run ``body(index)`` for ``count`` iterations, an SSA index.

        The loop ends early if ``body`` returns a mask without a set lane.
        """
        with cgutils.for_range(self.builder, count) as loop:
            active = body(loop.index)
            if active is not None:
                none_active = self.builder.icmp_unsigned("==", active.bits(), self.index(0))
                with self.builder.if_then(none_active, likely=False):
                    loop.do_break()


# -- Constants, exponentials and vector width of the raster kernels -------------------------------
#
# The kernels keep the state of a tile in *planes* of 256 values inside one float32 scratch array.
# A plane is ordered by *blocks* of 8 or 16 pixels, 4 wide and 2 or 4 high, each of which is one
# vector; blocks, and the pixels of a block, are numbered row by row.


TILE = limits.TILE_PX
PLANE = TILE * TILE
STRIDE = PLANE + TILE
"""Offset between planes. Not a divisor of 4096 bytes: loads would alias earlier stores."""
BLOCK_WIDTH = 4
BLOCK_COLUMNS = TILE // BLOCK_WIDTH
FEATURES = 9
ROW_VALUES = 24
"""Columns of params and of intersection gradients."""
# Planes of the forward scratch array.
TRANSMITTANCE, F0 = 0, 1
DEPTH, SLOPE = F0 + FEATURES, F0 + FEATURES + 1
BEST, BEST_AT = SLOPE + 1, SLOPE + 2
FORWARD_PLANES = BEST_AT + 1
PREFETCH_AHEAD = 8
"""Prefetch distance of rows, in intersections."""

ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
ALPHA_MIN = np.float32(limits.ALPHA_MIN)
ALPHA_MAX = np.float32(limits.ALPHA_MAX)
TRANSMITTANCE_MIN = np.float32(limits.TRANSMITTANCE_MIN)
ISO_LEVEL = np.float32(limits.ISO_LEVEL)
# No ray's den is smaller except by rounding; keeps 1 / den finite.
DENOMINATOR_MIN = np.float32(limits.DENOMINATOR_MIN)
FAR = np.float32(3e38)
FLOAT32_MAX = float(np.finfo(np.float32).max)
# Farther than this many sigma_z in front of its centre, a Gaussian's density is below 3e-7.
FRONT_SIGMAS = np.float32(5.5)
LIVENESS_EVERY = 32
"""Intersections between two updates of which blocks of a tile are not yet opaque."""

_LINE_VALUES = 16
# Pixels of a block relative to its first one.
LANE_X = (np.arange(TILE) % BLOCK_WIDTH).astype(np.float32)
LANE_Y = (np.arange(TILE) // BLOCK_WIDTH).astype(np.float32)

# exp(-y) on [0, 0.7] to 1e-7, fitted at Chebyshev nodes with relative weights; the constant term is
# exactly 1, so that exp(0) is 1.
FIT = np.array(
    [
        1.0,
        -0.9999997615814209,
        0.4999943971633911,
        -0.16662052273750305,
        0.04148262366652489,
        -0.00794854387640953,
        0.0009744596900418401,
    ],
    np.float32,
)
FIT_END = np.float32(0.7)
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = FIT
_EIGHTH, _THIRTY_SECOND = np.float32(1.0 / 8.0), np.float32(1.0 / 32.0)
WIDE_END = np.float32(32.0) * FIT_END
"""Where :func:`exp_wide` ends."""


@inline
def _exp_fit(y: Any) -> Any:
    """Return exp(-y) for 0 <= y <= 0.7."""
    return (((((_C6 * y + _C5) * y + _C4) * y + _C3) * y + _C2) * y + _C1) * y + _C0


@inline
def exp_short(x: Any) -> Any:
    """Return exp(-x) for 0 <= x <= 5.6, and less than 1/255 above (relative error 1.6e-6)."""
    p = _exp_fit(min(x * _EIGHTH, FIT_END))
    p = p * p
    p = p * p
    return p * p


@inline
def exp_wide(x: Any) -> Any:
    """Return exp(-x) for 0 <= x <= 22.4, and 0 above (relative error 7e-6).

    A small value instead of 0 would be amplified by the 1 / sigma^2 of thin Gaussians far behind.
    """
    p = _exp_fit(min(x * _THIRTY_SECOND, FIT_END))
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    return p if x <= WIDE_END else ZERO


@functools.lru_cache(maxsize=1)
def vector_lanes() -> int:
    """Return the number of pixels per block for the CPU that numba compiles for: 16 or 8."""
    # 16 where AVX-512 is compiled for.
    chosen = getattr(numba.config, "CPU_NAME", None)
    if chosen and chosen != llvmlite.binding.get_host_cpu_name():
        return 8
    features = llvmlite.binding.get_host_cpu_features()
    return 16 if features.get("avx512f") else 8


def aligned_zeros(count: int) -> np.ndarray:
    """Return ``count`` float32 aligned to a cache line, so that no vector spans two lines."""
    values = np.zeros(count + _LINE_VALUES, np.float32)
    offset = -(values.ctypes.data // values.itemsize) % _LINE_VALUES
    return values[offset : offset + count]


# -- Evaluate a Gaussian on the rays of a block of pixels, in explicit vectors; exponentials ------


SHORT_END, SIMD_MATH_WIDE_END = 8.0 * float(FIT_END), 32.0 * float(FIT_END)
"""Where :func:`exp_short` (exp(-5.6) < 1/255) and :func:`exp_wide` (exp(-22.4) = 2e-10) end."""


def simd_math_exp_short(x: Vector, scale: float = 1.0) -> Vector:
    """Return exp(-scale x) for 0 <= scale x <= SHORT_END (relative error 1.6e-6)."""
    return _power(_fit(x * (scale / 8.0)), 3)


def simd_math_exp_wide(x: Vector, scale: float = 1.0) -> Vector:
    """Return exp(-scale x) for 0 <= scale x <= WIDE_END, and 0 above (relative error 7e-6).

    A small value instead of 0 would be amplified by the 1 / sigma^2 of thin Gaussians far behind.
    """
    value = _power(_fit(x * (scale / 32.0)), 5)
    return (x < SIMD_MATH_WIDE_END / scale).select(value, 0.0)


def _fit(y: Vector) -> Vector:
    total = y * float(FIT[-1]) + float(FIT[-2])
    for coefficient in reversed(FIT[:-2]):
        total = total * y + float(coefficient)
    return total


def _power(value: Vector, squarings: int) -> Vector:
    for _ in range(squarings):
        value = value * value
    return value


@dataclass(frozen=True)
class RayEvaluation:
    """One Gaussian evaluated on the rays of a block; names as in docs/architecture.md."""

    dx: Vector  # pixel - projected mean
    dy: Vector
    inverse: Vector  # 1 / den
    den: Vector
    distance: Vector
    """Smallest squared Mahalanobis distance on the ray; clamped where alpha is below 1/255."""
    raw: Vector  # opacity on the ray before the cap
    alpha: Vector  # after the cap
    row: Row


class Row:
    """One row of params; each column is loaded and broadcast where it is used."""

    def __init__(self, block: Block, params: Any, gaussian: Any) -> None:
        self.block, self.params = block, params
        self.base = block.builder.mul(gaussian, block.index(ROW_VALUES))

    def single(self, column: int) -> Any:
        """Return a column as an SSA float32."""
        return self.block.scalar(self.params, self.block.offset(self.base, column))

    def __getitem__(self, column: int) -> Vector:
        return self.block.splat(self.single(column))


def first_pixel(block: Block, number: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Return the centre of a block's first pixel; that of the tile is ``(x, y)``."""
    builder, flags = block.builder, ("contract",)
    columns = BLOCK_COLUMNS
    column = builder.and_(number, block.index(columns - 1))
    row = builder.lshr(number, block.index(columns.bit_length() - 1))
    across = builder.mul(column, block.index(BLOCK_WIDTH))
    down = builder.mul(row, block.index(block.lanes // BLOCK_WIDTH))
    left = builder.fadd(x, builder.sitofp(across, x.type), flags=flags)
    return left, builder.fadd(y, builder.sitofp(down, y.type), flags=flags)


def evaluate_rays(block: Block, params: Any, gaussian: Any, left: Any, top: Any) -> RayEvaluation:
    """Evaluate a Gaussian on the rays of the block whose first pixel centre is ``(left, top)``."""
    row = Row(block, params, gaussian)
    builder, flags = block.builder, ("contract",)
    dx = block.constants(LANE_X[: block.lanes].tolist()) - block.splat(
        builder.fsub(row.single(0), left, flags=flags)
    )
    dy = block.constants(LANE_Y[: block.lanes].tolist()) - block.splat(
        builder.fsub(row.single(1), top, flags=flags)
    )
    num = ((dx * row[2] + dy * row[3]) * dx + dy * row[4] * dy).max(0.0)
    den = (dx * row[7] + (dy * row[8] + row[5] * 2.0)) * dx + (
        (dy * row[9] + row[6] * 2.0) * dy + 1.0
    )
    den = den.max(float(DENOMINATOR_MIN))
    inverse = den.reciprocal()
    distance = (num * inverse).min(2.0 * SHORT_END)
    raw = simd_math_exp_short(distance, 0.5) * row[11]
    return RayEvaluation(dx, dy, inverse, den, distance, raw, raw.min(float(ALPHA_MAX)), row)


def peak_depth(rays: RayEvaluation) -> Vector:
    """Return the z-depth of the Gaussian's maximum along each ray.

    Rounded identically wherever it is used: thin Gaussians resolve a depth's last bits.
    """
    row = rays.row
    return ((rays.dx * row[5] + (rays.dy * row[6] + 1.0)) * rays.inverse).times(row[10])


# -- Explicit vector instructions for numba kernels: runs of 8 or 16 float32, bits, prefetching
#
# Bounds are not checked: indices must be valid and not negative.


def _run_pointer(lanes: int, context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    """Return the LLVM pointer to the vector of ``lanes`` float32 at ``array[at]``."""
    data = context.make_array(kind)(context, builder, array).data
    vector = ir.VectorType(ir.FloatType(), lanes)
    return builder.bitcast(builder.gep(data, [at]), vector.as_pointer())


def compile_time(function: Callable[..., Any]) -> Any:
    """Make an intrinsic that gets integers and booleans known when compiling as literal types."""
    return intrinsic(prefer_literal=True)(function)


@compile_time
def copy_run(typingctx, lanes, target, target_at, source, source_at):  # type: ignore[no-untyped-def]
    """Copy one run of ``lanes`` (8 or 16) float32 as one vector.

    Instead of a loop: between two arrays, or two variable offsets of one array, LLVM cannot prove
    that the runs do not overlap, and falls back to scalar code.
    """

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        width = lanes.literal_value
        source_run = _run_pointer(width, context, builder, sig.args[3], args[3], args[4])
        target_run = _run_pointer(width, context, builder, sig.args[1], args[1], args[2])
        builder.store(builder.load(source_run, align=4), target_run, align=4)
        return context.get_dummy_value()

    return types.void(lanes, target, types.intp, source, types.intp), generate


@compile_time
def positive_run(typingctx, lanes, source, source_at):  # type: ignore[no-untyped-def]
    """Return as bits which values of one run of ``lanes`` (8 or 16) float32 are positive."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        width = lanes.literal_value
        run = _run_pointer(width, context, builder, sig.args[1], args[1], args[2])
        zeros = ir.Constant(ir.VectorType(ir.FloatType(), width), None)
        above = builder.fcmp_ordered(">", builder.load(run, align=4), zeros)
        return builder.zext(builder.bitcast(above, ir.IntType(width)), ir.IntType(64))

    return types.uint64(lanes, source, types.intp), generate


@compile_time
def lowest_bit(typingctx, bits):  # type: ignore[no-untyped-def]
    """Return the index of the lowest set bit of a uint64 other than 0."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate


def _prefetch_intrinsic(locality: int) -> Any:
    """Make a function that prefetches a row of a C-contiguous (n, 24) float32 array.

    Tiles access rows in an order that the processor cannot predict; waiting for them took a third
    of the time.
    """

    @intrinsic
    def prefetch(typingctx, rows, row):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            data = context.make_array(sig.args[0])(context, builder, args[0]).data
            byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
            kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
            fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
            first = builder.mul(args[1], ir.Constant(args[1].type, ROW_VALUES))
            for offset in (0, ROW_VALUES - 1):  # 96 bytes lie on two cache lines
                pointer = builder.gep(data, [builder.add(first, ir.Constant(first.type, offset))])
                hints = [ir.Constant(word, value) for value in (0, locality, 1)]  # read, data
                builder.call(fetch, [builder.bitcast(pointer, byte), *hints])
            return context.get_dummy_value()

        return types.void(rows, types.intp), generate

    return prefetch


prefetch_row, prefetch_row_early = _prefetch_intrinsic(3), _prefetch_intrinsic(2)
"""Into the first-level cache; into the second-level cache, for a row that is read much later."""
