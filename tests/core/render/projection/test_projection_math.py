# SPDX-License-Identifier: GPL-3.0-or-later
"""Exponential, logarithm and hyperbolic tangent of the projection against 40 digits."""

from __future__ import annotations

from collections.abc import Callable

import mpmath
import numpy as np
import pytest

from gaussian_wrapping_addon.core.compiled import kernel
from gaussian_wrapping_addon.core.render.projection_kernels import (
    block_scratch,
    exp_parts,
    exp_wide,
    log_wide,
)


@kernel(fast=False, fused=True)
def _evaluate(x: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(x)):
        scale, p = exp_parts(x[i])
        out[0, i] = exp_wide(x[i])
        out[1, i] = (scale - 1.0) + scale * p
        out[2, i] = log_wide(x[i])


@kernel(fast=False, fused=True)
def _scratch(planes: int) -> np.ndarray:
    return block_scratch(planes)


def evaluated(values: np.ndarray) -> np.ndarray:
    out = np.zeros((3, len(values)))
    _evaluate(np.ascontiguousarray(values, np.float64), out)
    return out


def relative_error(got: np.ndarray, wanted: Callable[..., mpmath.mpf], x: np.ndarray) -> float:
    with mpmath.workdps(40):
        exact = [wanted(mpmath.mpf(float(value))) for value in x]
        pairs = zip(got, exact, strict=True)
        return float(max(abs((mpmath.mpf(float(g)) - e) / e) for g, e in pairs))


RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize("reach", [1e-12, 0.4, 30.0, 708.0])
def test_exponential(reach: float) -> None:
    x = np.concatenate([RANDOM.uniform(-reach, reach, 2000), [reach, -reach]])
    got = evaluated(x)
    assert relative_error(got[0], mpmath.exp, x) < 3e-16
    assert relative_error(got[1], mpmath.expm1, x) < 6e-16


def test_exponential_at_its_ends() -> None:
    x = np.array([0.0, -0.0, 709.0, 709.1, np.inf, -708.1, -np.inf, np.nan])
    got = evaluated(x)[0]
    np.testing.assert_array_equal(got[[0, 1, 3, 4, 5, 6]], [1.0, 1.0, np.inf, np.inf, 0.0, 0.0])
    assert relative_error(got[2:3], mpmath.exp, x[2:3]) < 3e-16
    assert np.isnan(got[7])


def test_logarithm() -> None:
    x = np.concatenate([RANDOM.uniform(1.0, 256.0, 2000), 10.0 ** RANDOM.uniform(-300, 300, 1000)])
    got = evaluated(x)[2]
    assert relative_error(got, mpmath.log, x) < 1e-15
    # Near 1 the result is small, and the error too.
    x = 1.0 + RANDOM.uniform(-1e-3, 1e-3, 1000) * 10.0 ** RANDOM.uniform(-10, 0, 1000)
    x = x[x != 1.0]
    assert relative_error(evaluated(x)[2], mpmath.log, x) < 1e-15
    assert evaluated(np.ones(1))[2, 0] == 0.0


def test_scratch_begins_at_a_cache_line() -> None:
    for planes in (1, 7, 100):
        values = _scratch(planes)
        assert values.shape == (8 * planes,)
        assert values.ctypes.data % 64 == 0
