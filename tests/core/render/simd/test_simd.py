# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of explicit vectors against numpy, at both widths."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import pytest
from numba.core import cgutils, types
from numba.extending import intrinsic

from gaussian_wrapping_addon.core.render.simd import Block, State


def _unary(lanes: int, body: Any) -> Any:
    """Compile ``out[:lanes] = body(values[:lanes])``."""

    @intrinsic
    def apply(typingctx, values, out):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            block = Block(lanes, context, builder)
            source = block.data(sig.args[0], args[0])
            block.store(
                body(block, block.load(source, block.index(0)), source),
                block.data(sig.args[1], args[1]),
                block.index(0),
            )
            return context.get_dummy_value()

        return types.void(values, out), generate

    @numba.njit
    def run(values, out):  # type: ignore[no-untyped-def]
        apply(values, out)

    def call(values: np.ndarray) -> np.ndarray:
        out = np.zeros(lanes, np.float32)
        run(np.ascontiguousarray(values, np.float32), out)
        return out

    return call


@pytest.mark.parametrize("lanes", [8, 16])
def test_logarithm(lanes: int) -> None:
    log = _unary(lanes, lambda block, x, _: x.log())
    random = np.random.default_rng(0)
    for scale in (1e-30, 1e-3, 1.0, 1e3, 1e30):
        x = (scale * random.uniform(0.5, 2.0, lanes)).astype(np.float32)
        exact = np.log(x.astype(np.float64))
        assert np.abs(log(x) - exact).max() <= 2e-7 * max(1.0, np.abs(exact).max())
    near_one = (1.0 + random.uniform(-1e-3, 1e-3, lanes)).astype(np.float32)
    assert np.abs(log(near_one) - np.log(near_one.astype(np.float64))).max() < 1e-9


@pytest.mark.parametrize("lanes", [8, 16])
def test_arithmetic_and_choices(lanes: int) -> None:
    x = np.random.default_rng(1).normal(size=lanes).astype(np.float32)
    root = _unary(lanes, lambda block, v, _: (v * v + 1.0).sqrt())
    np.testing.assert_allclose(root(x), np.sqrt(x.astype(np.float64) ** 2 + 1), rtol=1e-6)
    np.testing.assert_array_equal(_unary(lanes, lambda b, v, _: v.abs())(x), np.abs(x))
    np.testing.assert_array_equal(
        _unary(lanes, lambda b, v, _: v.max(0.25).min(0.5))(x), x.clip(0.25, 0.5)
    )
    chosen = _unary(lanes, lambda b, v, _: ((v > 0.0) & ~(v >= 1.0)).select(2.0, v))(x)
    np.testing.assert_array_equal(chosen, np.where((x > 0) & (x < 1), np.float32(2), x))
    np.testing.assert_allclose(_unary(lanes, lambda b, v, _: 1.0 / v)(x), 1.0 / x, rtol=1e-6)


@pytest.mark.parametrize("lanes", [8, 16])
def test_totals_of_many_vectors(lanes: int) -> None:
    count = lanes + 3

    def body(block: Block, first: Any, source: Any) -> Any:
        vectors = [block.load(source, block.index(k * lanes)) for k in range(count)]
        sums = block.totals(vectors)
        assert len(sums) == 2
        return sums[1]

    values = np.random.default_rng(2).normal(size=(count, lanes)).astype(np.float32)
    found = _unary(lanes, body)(values.reshape(-1))
    np.testing.assert_allclose(found[:3], values[lanes:].sum(1), rtol=1e-5, atol=1e-6)
    assert not found[3:].any()


@pytest.mark.parametrize("lanes", [8, 16])
def test_loops_keep_their_state(lanes: int) -> None:
    def body(block: Block, x: Any, source: Any) -> Any:
        total, builder = State(block, 0.0), block.builder
        place = cgutils.alloca_once_value(builder, block.index(0))

        def add(index: Any) -> Any:
            total.set(total.get() + x)
            return builder.icmp_signed("<", index, block.index(4))  # five turns: 0 to 4

        always = builder.icmp_signed("==", block.index(0), block.index(0))
        block.walk(place, block.index(100), add, lambda _: always)
        block.walk(place, block.index(7), lambda _: add(_) and always, lambda _: always)
        block.each_bit(block.index(0b1011), lambda bit: add(bit) and None)
        block.repeat(block.index(10), lambda _: total.set(total.get() + 1.0) or total.get() < 1e3)
        return total.get()

    x = np.linspace(1.0, 2.0, lanes).astype(np.float32)
    # Five turns, two more up to 7, three bits, then ten times 1.
    np.testing.assert_allclose(_unary(lanes, body)(x), 10.0 * x + 10.0, rtol=1e-6)
    # Lanes beyond 1000 end the last loop only together.
    np.testing.assert_allclose(_unary(lanes, body)(1e3 * x), 1e4 * x + 1.0, rtol=1e-6)
    assert math.isfinite(float(_unary(lanes, body)(x).sum()))
