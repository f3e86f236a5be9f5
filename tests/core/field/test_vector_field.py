# SPDX-License-Identifier: GPL-3.0-or-later
"""The vector field against its definition, finite differences and hard cases."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.vacancy_scale import log_gaussian, log_one_minus
from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.field.vector_field import TAIL, VectorField
from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from tests.core.field.field_scenes import (
    around_shell,
    make_arrays,
    random_arrays,
    shell_arrays,
    unit_sphere,
)


def whitened(arrays: GaussianArrays, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S^-1 R^T (m, 3, 3) and S^-1 R^T (x - mu) (n, m, 3)."""
    L = arrays.rotations.transpose(0, 2, 1) / arrays.scales[:, :, None]
    return L, np.einsum("mij,nmj->nmi", L, points[:, None] - arrays.means)


def odds(log_g: np.ndarray) -> np.ndarray:
    """Return ``H = G / (1 - G)``, 0 where G underflows."""
    with np.errstate(over="ignore"):
        return 1.0 / np.expm1(-np.asarray(log_g, np.float64))


def by_definition(arrays: GaussianArrays, points: np.ndarray, tail: float = 1e-300) -> np.ndarray:
    """Return V with every Gaussian whose value is at least ``tail``."""
    L, local = whitened(arrays, points)
    log_g = log_gaussian(arrays.log_opacities, (local**2).sum(-1))
    side = np.einsum("mi,nmi->nm", arrays.normals, points[:, None] - arrays.means) >= 0.0
    side |= np.linalg.norm(arrays.normals, axis=1) < limits.ORIENTED_MIN_NORM
    weight = np.where(side & (log_g >= np.log(tail)), odds(log_g), 0.0)
    return np.einsum("nm,mji,nmj->ni", weight, L, local)


def log_product(arrays: GaussianArrays, points: np.ndarray) -> np.ndarray:
    """Return sum_i log(1 - G_i)."""
    _, local = whitened(arrays, points)
    return log_one_minus(log_gaussian(arrays.log_opacities, (local**2).sum(-1))).sum(1)


@pytest.mark.parametrize("scale", [(1e-4, 0.5), (1e-3, 30.0)])
def test_field_equals_its_definition(scale: tuple[float, float]) -> None:
    arrays = random_arrays(300, seed=2, scale=scale)
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [
            rng.normal(size=(200, 3)),
            arrays.means + 0.5 * arrays.scales.min(1)[:, None] * rng.normal(size=(300, 3)),
            100.0 * rng.normal(size=(20, 3)),
        ]
    )
    exact = by_definition(arrays, points, TAIL)
    got = VectorField(arrays).evaluate(points).V
    size = np.linalg.norm(exact, axis=1)
    assert (size > 0.0).sum() > 100
    assert (np.linalg.norm(got - exact, axis=1) <= 1e-10 * size).all()


def test_tails_left_out_are_bounded() -> None:
    arrays = random_arrays(300, seed=2, scale=(0.05, 0.3))
    points = np.random.default_rng(0).normal(size=(300, 3))
    missing = np.linalg.norm(
        VectorField(arrays).evaluate(points).V - by_definition(arrays, points), axis=1
    )
    L, local = whitened(arrays, points)
    log_g = log_gaussian(arrays.log_opacities, (local**2).sum(-1))
    pull = np.linalg.norm(np.einsum("mji,nmj->nmi", L, local), axis=2)
    bound = np.where(log_g < np.log(TAIL), TAIL / (1.0 - TAIL) * pull, 0.0).sum(1)
    assert (missing <= bound + 1e-9).all()
    assert missing.max() > 0.0


def test_unoriented_field_is_the_gradient_of_the_log_product() -> None:
    arrays = random_arrays(60, seed=5, scale=(0.3, 0.8))
    points = 0.5 * np.random.default_rng(1).normal(size=(50, 3))
    got = VectorField(arrays, oriented=False).evaluate(points).V
    step = 1e-5
    numeric = np.stack(
        [
            log_product(arrays, points + step * axis) - log_product(arrays, points - step * axis)
            for axis in np.eye(3)
        ],
        1,
    ) / (2.0 * step)
    # The dropped tails are worth 1e-4 each.
    np.testing.assert_allclose(got, numeric, atol=60 * TAIL * 4.0 / 0.3)
    exact = by_definition(dataclasses.replace(arrays, normals=0.0 * arrays.normals), points)
    np.testing.assert_allclose(exact, numeric, rtol=1e-7, atol=1e-7)


def test_back_side_contributes_nothing() -> None:
    normal = np.array([0.0, 0.6, 0.8])
    points = np.stack([0.1 * normal, -0.1 * normal])
    arrays = make_arrays(np.zeros(3), 0.1, 0.9, normals=0.5 * normal[None])
    V = VectorField(arrays).evaluate(points).V
    assert (V[1] == 0.0).all()
    expected = float(odds(np.log(0.9) - 0.5)) / 0.1
    np.testing.assert_allclose(V[0], expected * normal, rtol=1e-12)
    both = VectorField(arrays, oriented=False).evaluate(points).V
    np.testing.assert_allclose(both[1], -V[0], rtol=1e-12)


def test_short_normals_are_not_oriented() -> None:
    point = np.array([[0.0, 0.0, -0.1]])
    for length, acts in ((0.049, True), (0.051, False), (0.0, True)):
        arrays = make_arrays(np.zeros(3), 0.1, 0.9, normals=np.array([[0.0, 0.0, length]]))
        assert VectorField(arrays).evaluate(point).V.any() == acts


def test_large_body_with_a_far_mean_is_found_among_tiny_clusters() -> None:
    """The nearest means alone would miss it (docs/method.md, section 5.2)."""
    cluster = 0.01 * unit_sphere(300)
    means = np.concatenate([cluster, [[3.0, 0.0, 0.0]]])
    scales = np.concatenate([np.full((300, 3), 1e-4), [[3.0, 0.2, 0.2]]])
    V = VectorField(make_arrays(means, scales, 0.9)).evaluate(np.zeros((1, 3))).V[0]
    expected = float(odds(np.log(0.9) - 0.5)) * -3.0 / 9.0
    np.testing.assert_allclose(V, [expected, 0.0, 0.0], rtol=1e-12)


@pytest.mark.parametrize("logit", [-20.0, 36.0])
def test_centre_of_faint_and_opaque_gaussians(logit: float) -> None:
    arrays, log_alpha = make_arrays(np.zeros(3), 0.1, 0.5), -np.log1p(np.exp(-logit))
    arrays.log_opacities[:] = log_alpha
    points = np.array([[0.0, 0.0, 0.0], [1e-9, 0.0, 0.0], [0.05, 0.0, 0.0]])
    V = VectorField(arrays).evaluate(points).V
    assert np.isfinite(V).all()
    if logit < 0.0:
        assert (V == 0.0).all()  # fainter than the tail everywhere
        return
    expected = odds(log_alpha - 0.5 * (points[:, 0] / 0.1) ** 2) * points[:, 0] / 0.01
    np.testing.assert_allclose(V[:, 0], expected, rtol=1e-12)
    arrays.log_opacities[:] = 0.0
    assert np.isfinite(VectorField(arrays).evaluate(points).V).all()


def test_local_sigma_nearest_and_outward() -> None:
    means = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [9.0, 0.0, 0.0]])
    scales = np.array([[0.1, 0.2, 0.03], [0.1, 0.1, 0.05], [0.1, 0.1, 0.07]])
    normals = np.array([[0.0, 0.0, 0.9], [0.0, 0.0, 0.9], [0.0, 0.0, 0.01]])
    arrays = make_arrays(means, scales, [0.9, 0.5, 0.5], normals=normals)
    points = np.array([[0.0, 0.0, 0.01], [9.0, 0.0, 0.1], [50.0, 0.0, 0.0], [0.0, 0.0, -0.04]])
    result = VectorField(arrays).evaluate(points)
    np.testing.assert_array_equal(result.nearest, [0, 2, 2, 0])
    np.testing.assert_allclose(result.sigma_local, [0.05, 0.07, 0.05, 0.05])
    np.testing.assert_allclose(
        np.linalg.norm(result.outward, axis=1), [1.0, 1.0, 0.0, 1.0], atol=1e-12
    )
    np.testing.assert_allclose(result.outward[3], [0.0, 0.0, 1.0])  # behind: the learned normal
    assert (result.V[2] == 0.0).all()
    assert (result.V[3] == 0.0).all()


def test_threads_and_order_change_nothing() -> None:
    arrays = shell_arrays(0.9, count=500)
    points = around_shell(20_000, 0.02)
    one = VectorField(arrays, threads=1).evaluate(points)
    three = VectorField(arrays, threads=3).evaluate(points)
    mixed = np.random.default_rng(0).permutation(len(points))
    other = VectorField(arrays, threads=1).evaluate(points[mixed])
    for name in ("V", "sigma_local", "nearest", "outward"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
        np.testing.assert_array_equal(getattr(one, name)[mixed], getattr(other, name))


def test_nothing_and_nonsense() -> None:
    empty = VectorField(make_arrays(np.zeros((0, 3)), 0.1, 0.5)).evaluate(np.zeros((2, 3)))
    assert (empty.V == 0.0).all()
    assert (empty.nearest == -1).all()
    field = VectorField(make_arrays(np.zeros(3), 0.1, 0.5))
    result = field.evaluate(np.array([[np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0], [0.05, 0.0, 0.0]]))
    np.testing.assert_array_equal(result.nearest, [-1, -1, 0])
    assert (result.V[:2] == 0.0).all()
    assert result.V[2, 0] > 0.0
    assert len(field.evaluate(np.zeros((0, 3))).V) == 0
