# SPDX-License-Identifier: GPL-3.0-or-later
"""The largest rate of fused multiply-adds of one core, by the compiler of the kernels."""

from __future__ import annotations

import functools
import time
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

_CHAINS = 12
"""Independent vectors: more than latency times units of every core we know, fewer than registers
(16 with AVX2, of which two hold the factors)."""
_STEPS = 4
"""Unrolled multiply-adds per chain and turn of the loop."""


@functools.cache
def _chains(lanes: int) -> Any:
    """Compile a loop of ``count`` turns of multiply-adds on vectors of ``lanes`` float32."""

    @intrinsic
    def multiply_add(typingctx, count, start):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            vector = ir.VectorType(ir.FloatType(), lanes)
            fused = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fma.v{lanes}f32"
            )

            def filled(value: float) -> Any:
                return ir.Constant(vector, [value] * lanes)

            places = [cgutils.alloca_once(builder, vector) for _ in range(_CHAINS)]
            for i, place in enumerate(places):
                first = builder.insert_element(
                    filled(float(i)), args[1], ir.Constant(ir.IntType(32), 0)
                )
                builder.store(first, place)
            with cgutils.for_range(builder, args[0]):
                for place in places:
                    value = builder.load(place)
                    for _ in range(_STEPS):
                        value = builder.call(fused, [value, filled(0.999), filled(1e-3)])
                    builder.store(value, place)
            total = builder.load(places[0])
            for place in places[1:]:
                total = builder.fadd(total, builder.load(place))
            return builder.extract_element(total, ir.Constant(ir.IntType(32), 0))

        return types.float32(types.int64, types.float32), generate

    @numba.njit
    def run(count: int, start: float) -> float:
        return multiply_add(np.int64(count), np.float32(start))  # type: ignore[call-arg]

    return run


def fma_peak(lanes: int, *, repeats: int = 7, turns: int = 300_000) -> float:
    """Return the measured peak of one core in flops per second; a multiply-add counts as two."""
    run = _chains(lanes)
    run(1, 0.5)
    best = float("inf")
    for _ in range(repeats):
        begun = time.process_time()
        run(turns, 0.5)
        best = min(best, time.process_time() - begun)
    return 2.0 * turns * _CHAINS * _STEPS * lanes / best
