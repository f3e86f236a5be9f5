# SPDX-License-Identifier: GPL-3.0-or-later
"""Vectorised separable filters for the SSIM window.

Indices are not checked: a run reads and writes :data:`LANES` neighbouring values. Weights are
passed as a tuple so that they stay in registers: a loop over an array would reload them for each
run, as LLVM cannot prove that the target is another array.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.errors import RequireLiteralValue
from numba.extending import intrinsic

LANES = 16
"""Values per run. LLVM splits a run into as many registers as needed."""

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
