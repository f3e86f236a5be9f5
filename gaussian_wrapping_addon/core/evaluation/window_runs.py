# SPDX-License-Identifier: GPL-3.0-or-later
"""Filters on explicit vectors, for the separable window of the structural similarity.

Indices are not checked: a run reads and writes :data:`LANES` neighbouring values. Weights come as a
tuple, so that they stay in registers: a loop over an array of them would load them again for each
run, as LLVM cannot prove that the target is another array.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

LANES = 16
"""Values of a run. LLVM splits it into as many registers as the processor needs."""

TAPS = 11
RING = TAPS + 1
"""Rows that two neighbouring windows reach."""

_WORD = ir.IntType(32)


class _Runs:
    """Emits loads, sums and stores of runs of one function."""

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

    def load_taps(self, count: int, array_type: Any, array: Any, at: Any, step: Any) -> list[Any]:
        """Return the runs at ``at``, ``at + step`` and so on."""
        runs = []
        for tap in range(count):
            place = self.builder.add(at, self.builder.mul(step, ir.Constant(step.type, tap)))
            pointer = self.pointer(array_type, array, place)
            runs.append(self.builder.load(pointer, align=self.align))
        return runs

    def weighted(self, weights: list[Any], runs: list[Any]) -> Any:
        total = self.builder.fmul(weights[0], runs[0], flags=("contract",))
        for weight, run in zip(weights[1:], runs[1:], strict=True):
            part = self.builder.fmul(weight, run, flags=("contract",))
            total = self.builder.fadd(total, part, flags=("contract",))
        return total

    def store(self, run: Any, array_type: Any, array: Any, at: Any) -> None:
        self.builder.store(run, self.pointer(array_type, array, at), align=self.align)


@intrinsic
def filter_run(typingctx, target, target_at, source, source_at, step, weights):  # type: ignore[no-untyped-def]
    """``target[target_at + j] = sum_k weights[k] source[source_at + k step + j]``, 11 weights."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        runs = _Runs(context, builder, sig.args[0].dtype)
        taps = [runs.splat(builder.extract_value(args[5], tap)) for tap in range(TAPS)]
        loaded = runs.load_taps(TAPS, sig.args[2], args[2], args[3], args[4])
        runs.store(runs.weighted(taps, loaded), sig.args[0], args[0], args[1])
        return context.get_dummy_value()

    tuples = types.UniTuple(source.dtype, TAPS)
    return types.void(target, types.intp, source, types.intp, types.intp, tuples), generate


@intrinsic
def filter_two_runs(typingctx, target, target_at, apart, source, source_at, step, weights):  # type: ignore[no-untyped-def]
    """Filter a ring of 12 rows for two windows that begin in neighbouring rows, loading it once.

    ``target[target_at + j]`` takes row k with ``weights[k]``, and ``target[target_at + apart + j]``
    with ``weights[k - 1]``, in the ring.
    """

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        runs = _Runs(context, builder, sig.args[0].dtype)
        taps = [runs.splat(builder.extract_value(args[6], tap)) for tap in range(RING)]
        loaded = runs.load_taps(RING, sig.args[3], args[3], args[4], args[5])
        first = runs.weighted(taps, loaded)
        second = runs.weighted(taps[-1:] + taps[:-1], loaded)
        runs.store(first, sig.args[0], args[0], args[1])
        runs.store(second, sig.args[0], args[0], builder.add(args[1], args[2]))
        return context.get_dummy_value()

    tuples = types.UniTuple(source.dtype, RING)
    index = types.intp
    return types.void(target, index, index, source, index, index, tuples), generate
