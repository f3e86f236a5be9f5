# SPDX-License-Identifier: GPL-3.0-or-later
"""Explicit SIMD vectors of 8 or 16 float32 in numba kernels, with arithmetic operators.

The bodies of numba *intrinsics* are written with operators on :class:`Vector`, which emit LLVM IR.
Unlike a loop, which LLVM may fail to vectorise if it cannot rule out overlapping memory, this code
is always packed, keeps its state in registers across its own loops, and compiles to the same
instructions wherever it is used. Bounds are not checked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils

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

    def __radd__(self, other: float) -> Vector:
        return self._binary("fadd", other)

    def __sub__(self, other: Vector | float) -> Vector:
        return self._binary("fsub", other)

    def __rsub__(self, other: float) -> Vector:
        return self._binary("fsub", other, swapped=True)

    def __mul__(self, other: Vector | float) -> Vector:
        return self._binary("fmul", other)

    def __rmul__(self, other: float) -> Vector:
        return self._binary("fmul", other)

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


class Block:
    """Emits vector code of one width into a numba intrinsic.

    Parameters
    ----------
    lanes : int
        8 or 16.
    context, builder
        Arguments of the code generator of a numba intrinsic.
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
                self._shuffle(a, b, first) + self._shuffle(a, b, second)
                for a, b in zip(level[::2], level[1::2], strict=True)
            ]
            group = half
        return level

    def _shuffle(self, a: Vector, b: Vector, order: Sequence[int]) -> Vector:
        indices = ir.Constant(
            ir.VectorType(_WORD, self.lanes), [ir.Constant(_WORD, k) for k in order]
        )
        return Vector(self, self.builder.shuffle_vector(a.value, b.value, indices))

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
