# SPDX-License-Identifier: GPL-3.0-or-later
"""The earlier field against closed forms, against its definition, and against the vacancy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from benchmarks.paper.earlier_field import EarlierField, brute_force_field, log_transmittance
from gaussian_wrapping_addon.core.field.vacancy import brute_force
from gaussian_wrapping_addon.core.field.vacancy.vacancy import SETTLED, VacancyField
from tests.core.field.field_scenes import (
    around_shell,
    camera_at,
    cameras_around,
    make_arrays,
    random_arrays,
    shell_arrays,
)

EYE = np.array([0.0, 0.0, -3.0])
SIGMA = 0.1


def crossing(log_t, low: float, high: float) -> float:
    """Return the place on the axis, in deviations, where the transmittance is 0.5."""

    def residual(z: float) -> float:
        return float(log_t(np.array([[0.0, 0.0, SIGMA * z]]))[0]) - math.log(0.5)

    return float(brentq(residual, low, high, xtol=1e-12))


@pytest.mark.parametrize("alpha", [0.76, 0.8, 0.95, 0.99, 0.999])
def test_level_of_one_gaussian_in_either_definition(alpha: float) -> None:
    """Before the centre: sqrt(2 log(2 a)) deviations here, sqrt(2 log(a / 0.75)) there."""
    arrays = make_arrays(np.zeros(3), SIGMA, alpha)
    ours = crossing(lambda x: brute_force.log_transmittance(arrays, EYE, x), -8.0, -1e-9)
    earlier = crossing(lambda x: log_transmittance(arrays, EYE, x), -8.0, -1e-9)
    assert ours == pytest.approx(-math.sqrt(2.0 * math.log(2.0 * alpha)), abs=1e-8)
    assert earlier == pytest.approx(-math.sqrt(2.0 * math.log(alpha / 0.75)), abs=1e-8)


@pytest.mark.parametrize("alpha", [0.51, 0.6, 0.74])
def test_level_behind_the_centre(alpha: float) -> None:
    """Below 0.75 the earlier level lies behind the centre, where the other never does."""
    arrays = make_arrays(np.zeros(3), SIGMA, alpha)
    earlier = crossing(lambda x: log_transmittance(arrays, EYE, x), 1e-9, 8.0)
    behind = math.sqrt(2.0 * math.log(alpha / (1.0 - 4.0 * (1.0 - alpha) ** 2)))
    assert earlier == pytest.approx(behind, abs=1e-8)
    ours = crossing(lambda x: brute_force.log_transmittance(arrays, EYE, x), -8.0, -1e-9)
    assert ours < 0.0


def test_both_end_at_what_blending_leaves() -> None:
    arrays = random_arrays(40, seed=3)
    far = 50.0 * np.random.default_rng(0).normal(size=(200, 3))
    far[:, 2] = 60.0
    np.testing.assert_allclose(
        log_transmittance(arrays, EYE, far),
        brute_force.log_transmittance(arrays, EYE, far),
        atol=1e-12,
    )


@pytest.mark.parametrize(("alpha", "gone"), [(0.7, True), (0.8, False)])
def test_faint_gaussian_vanishes_from_the_earlier_solid(alpha: float, gone: bool) -> None:
    """Two cameras that face each other leave nothing of a Gaussian below 0.75."""
    arrays = make_arrays(np.zeros(3), SIGMA, alpha)
    cameras = [camera_at(np.array([0.1, 0.2, z])) for z in (-3.0, 3.0)]
    points = SIGMA * np.random.default_rng(0).uniform(-2, 2, (4000, 3))
    inside = brute_force_field(arrays, cameras, points) <= 0.5
    assert inside.any() != gone
    assert (VacancyField(arrays, cameras, threads=1).vacancy(points).vacancy <= 0.5).any()


def test_kernel_follows_the_definition() -> None:
    arrays, cameras = shell_arrays(0.9, count=600), cameras_around(8)
    points = around_shell(3000, 0.02)
    found = EarlierField(arrays, cameras, threads=1).vacancy(points).vacancy
    true = brute_force_field(arrays, cameras, points)
    known = ~np.isnan(true)
    assert known.all()
    # The cut-offs of the field: tails of overlapping Gaussians, as in VacancyField's own bound.
    assert np.abs(found - true).max() < 0.03
    assert np.median(np.abs(found - true)) < 0.005


def test_side_of_points_is_that_of_their_value() -> None:
    arrays, cameras = shell_arrays(0.9, count=600), cameras_around(8)
    points = around_shell(3000, 0.02, seed=1)
    field = EarlierField(arrays, cameras, threads=1)
    np.testing.assert_array_equal(field.is_empty(points), field.vacancy(points).vacancy > 0.5)


def test_earlier_solid_lies_inside_of_the_other() -> None:
    arrays, cameras = shell_arrays(0.8, count=600), cameras_around(8)
    points = around_shell(4000, 0.03, seed=2)
    earlier = EarlierField(arrays, cameras, threads=1).vacancy(points).vacancy
    ours = VacancyField(arrays, cameras, threads=1).vacancy(points).vacancy
    # Above SETTLED, values are lower bounds.
    assert (earlier >= np.minimum(ours, SETTLED) - 1e-5).all()
    eroded = (ours <= 0.5) & (earlier > 0.5)
    assert eroded.any()
    assert (earlier <= 0.5).any()
