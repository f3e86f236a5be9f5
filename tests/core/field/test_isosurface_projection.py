# SPDX-License-Identifier: GPL-3.0-or-later
"""Projection onto the isosurface: closed forms, a shell, misleading fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from benchmarks.vacancy_scale import brute_force_vacancy
from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.field.isosurface_projection import (
    MAX_TRAVEL_SIGMAS,
    TOLERANCE,
    ProjectionResult,
    ProjectionStatus,
    project_to_isosurface,
)
from gaussian_wrapping_addon.core.field.vacancy import VacancyField, VacancyResult
from gaussian_wrapping_addon.core.field.vector_field import VectorField, VectorFieldResult
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.field.field_scenes import (
    around_shell,
    camera_at,
    cameras_around,
    make_arrays,
    shell_arrays,
    unit_sphere,
)


class LineField:
    """Vacancy and V given as functions of x; one camera far off on the +x axis sees x < limit."""

    def __init__(
        self,
        vacancy: Callable[[np.ndarray], np.ndarray],
        slope: Callable[[np.ndarray], np.ndarray] = np.zeros_like,
        sigma: float = 0.1,
        outward: float = 0.0,
    ) -> None:
        self.of_x, self.slope, self.sigma, self.outward = vacancy, slope, sigma, outward
        self.limit = np.inf
        self.asked: list[np.ndarray] = []

    @property
    def cameras(self) -> Sequence[Camera]:
        return [camera_at(np.array([1000.0 * self.sigma, 0.0, 0.0]))]

    def vacancy(self, points: np.ndarray) -> VacancyResult:
        self.asked.append(points.copy())
        seen = points[:, 0] < self.limit
        value = np.where(seen, self.of_x(points[:, 0]), 1.0)
        return VacancyResult(value.astype(np.float32), np.where(seen, 0, -1).astype(np.int32))

    def evaluate(self, points: np.ndarray) -> VectorFieldResult:
        V = np.zeros((len(points), 3))
        V[:, 0] = self.slope(points[:, 0])
        outward = np.zeros((len(points), 3))
        outward[:, 0] = np.nan_to_num(np.sign(V[:, 0])) if V.any() else self.outward
        return VectorFieldResult(
            V, np.full(len(points), self.sigma), np.zeros(len(points), np.int32), outward
        )

    def project(self, starts: list[float], tolerance: float = 1e-3) -> ProjectionResult:
        points = np.zeros((len(starts), 3))
        points[:, 0] = starts
        result = project_to_isosurface(points, self, self, tolerance=tolerance)
        everything = np.concatenate(self.asked)
        # No evaluation either, let alone the result, leaves the neighbourhood of some start.
        away = np.abs(everything[:, None, 0] - np.array(starts)).min(1)
        assert away.max() <= MAX_TRAVEL_SIGMAS * self.sigma * (1 + 1e-9)
        check_bookkeeping(result, tolerance)
        assert result.vacancy_evaluations == len(everything)
        return result


def check_bookkeeping(result: ProjectionResult, tolerance: float) -> None:
    """Every point has a status, and the residual is what the vacancy says."""
    assert set(np.unique(result.status)) <= {int(s) for s in ProjectionStatus}
    np.testing.assert_allclose(result.residual, np.abs(result.vacancy - 0.5), atol=1e-7)
    assert (result.residual[result.on_surface] <= tolerance).all()
    assert (result.camera[result.on_surface] >= 0).all()
    assert np.isfinite(result.points).all()


WALL = np.sqrt(2.0 * np.log(1.9))
"""Where :func:`half_gaussian` is 0.5, in sigmas."""


def half_gaussian(sigma: float = 0.1) -> LineField:
    """Return the field of one wall whose outward side is +x (docs/method.md, section 10.3)."""

    def vacancy(x: np.ndarray) -> np.ndarray:
        return 1.0 - 0.95 * np.exp(-0.5 * (np.maximum(x, 0.0) / sigma) ** 2)

    def slope(x: np.ndarray) -> np.ndarray:
        q = (x / sigma) ** 2
        return np.where(x >= 0.0, x / sigma**2 / np.expm1(0.5 * q - np.log(0.95)), 0.0)

    return LineField(vacancy, slope, sigma, outward=1.0)


@pytest.mark.parametrize("sigma", [1e-3, 1.0])
def test_wall_of_any_size_is_reached_quickly_and_from_everywhere_near(sigma: float) -> None:
    field = half_gaussian(sigma)
    start = sigma * np.sqrt(2.0 * np.log(0.95 / (1.0 - 0.5935)))
    result = field.project([start], tolerance=1e-6)
    assert result.on_surface.all()
    assert abs(result.points[0, 0] - WALL * sigma) < 2e-6 * sigma
    assert len(field.asked) <= 7
    # The first step is Newton's on log v.
    first = field.of_x(field.asked[1][:, 0])[0]
    assert abs(abs(first - 0.5) - 1.3e-2) < 1e-3
    result = half_gaussian(sigma).project((sigma * np.linspace(-9.0, 9.0, 181)).tolist())
    assert result.on_surface.all()
    np.testing.assert_allclose(result.points[:, 0], WALL * sigma, atol=5e-3 * sigma)


def test_vector_field_that_vanishes() -> None:
    for outward in (1.0, 0.0):
        field = half_gaussian()
        field.slope, field.outward = np.zeros_like, outward
        result = field.project([-0.3, 0.05, 0.2, 0.4])
        assert (result.status == ProjectionStatus.BISECTED).all()
        np.testing.assert_allclose(result.points[:, 0], 0.1 * WALL, atol=1e-3)


def test_vector_field_opposed_to_the_slope() -> None:
    """V leads away; the ray of the camera leads back, and nothing runs off."""
    field = half_gaussian()
    truth = field.slope
    field.slope = lambda x: -truth(x)
    result = field.project([0.02, 0.1, 0.2])
    assert result.on_surface[:2].all()
    np.testing.assert_allclose(result.points[:2, 0], 0.1 * WALL, atol=1e-3)


@pytest.mark.parametrize("level", [0.0, 0.3, 0.7, 1.0])
def test_plateau_is_dropped_where_it_is(level: float) -> None:
    for slope in (0.0, 5.0, -5.0, 1e9, 1e-9):
        field = LineField(lambda x: np.full_like(x, level), lambda x, s=slope: np.full_like(x, s))
        result = field.project([0.0, 0.5])
        assert (result.status == ProjectionStatus.DROPPED).all()
        np.testing.assert_allclose(result.residual, abs(level - 0.5), atol=1e-6)
        np.testing.assert_array_equal(result.points[:, 0], [0.0, 0.5])


def test_plateau_exactly_at_the_level_is_kept() -> None:
    field = LineField(lambda x: np.full_like(x, 0.5))
    assert field.project([0.0]).status[0] == ProjectionStatus.CONVERGED
    assert len(field.asked) == 1


def test_jump_is_dropped_beside_the_jump_but_for_a_side_within_the_tolerance() -> None:
    def jump(low: float, high: float) -> LineField:
        return LineField(lambda x: np.where(x > 0.013, high, low), outward=1.0)

    result = jump(0.1, 0.9).project([-0.05, 0.05])
    assert (result.status == ProjectionStatus.DROPPED).all()
    np.testing.assert_allclose(result.residual, 0.4, atol=1e-6)
    result = jump(0.2, 0.508).project([-0.05, 0.05], tolerance=0.01)
    assert result.on_surface.all()
    np.testing.assert_allclose(result.residual, 0.008, atol=1e-6)
    assert (result.points[:, 0] > 0.013).all()


def test_unseen_and_nonfinite_fields_are_reported() -> None:
    field = half_gaussian()
    field.limit = 0.15
    result = field.project([0.3, 0.02, -0.1])
    assert result.status[0] == ProjectionStatus.DROPPED
    assert result.camera[0] == -1
    assert result.points[0, 0] == 0.3
    assert result.on_surface[1:].all()
    broken = half_gaussian()
    truth = broken.slope
    broken.slope = lambda x: np.where(x > 0.15, np.inf, np.where(x > 0.1, np.nan, truth(x)))
    assert broken.project([0.2, 0.12, 0.01]).on_surface.all()


def test_more_steps_than_allowed_are_dropped() -> None:
    field = half_gaussian()
    result = project_to_isosurface(np.array([[-0.3, 0, 0]]), field, field, max_steps=3)
    assert len(field.asked) == 3
    assert result.status[0] == ProjectionStatus.DROPPED
    assert len(project_to_isosurface(np.zeros((0, 3)), field, field).points) == 0
    with pytest.raises(Cancelled):
        project_to_isosurface(np.zeros((1, 3)), field, field, Progress(is_cancelled=lambda: True))


@pytest.mark.parametrize("sigma", [1e-3, 1.0])
def test_single_gaussian_gives_its_sphere(sigma: float) -> None:
    arrays = make_arrays(np.zeros(3), sigma, 0.95)
    cameras = cameras_around(12, radius=40.0 * sigma)
    field = VacancyField(arrays, cameras, near_z=sigma)
    starts = unit_sphere(400) * sigma * np.linspace(0.3, 3.5, 400)[:, None]
    result = project_to_isosurface(starts, field, VectorField(arrays), tolerance=1e-3)
    check_bookkeeping(result, 1e-3)
    assert result.on_surface.all()
    radius = np.linalg.norm(result.points, axis=1) / sigma
    np.testing.assert_allclose(radius, WALL, atol=2.5e-3)


@pytest.mark.parametrize(("alpha", "offset"), [(0.6, 1.76), (0.99, 2.17)])
def test_shell_lies_outside_its_centres(alpha: float, offset: float) -> None:
    """The known offsets of docs/method.md, section 10.3, in thicknesses of the Gaussians."""
    arrays = shell_arrays(alpha)
    field, vectors = VacancyField(arrays, cameras_around(16)), VectorField(arrays)
    starts = around_shell(1500, 0.01)
    result = project_to_isosurface(starts, field, vectors, tolerance=2e-3)
    check_bookkeeping(result, 2e-3)
    assert result.on_surface.mean() > 0.999
    kept = result.on_surface
    found = (np.linalg.norm(result.points[kept], axis=1) - 1.0) / 0.005
    assert abs(np.median(found) - offset) < 0.1
    assert np.abs(found - offset).max() < 0.1
    travel = np.linalg.norm(result.points - starts, axis=1)
    assert travel.max() <= MAX_TRAVEL_SIGMAS * 0.005 * (1 + 1e-9)
    exact, _ = brute_force_vacancy(arrays, field.cameras, result.points[kept][:60])
    assert np.abs(exact - 0.5).max() < 0.014
    assert result.vacancy_evaluations < 8 * len(starts)


def test_projection_scales_with_the_scene_and_ignores_threads() -> None:
    starts = around_shell(400, 0.008)
    results = []
    for scale, threads in ((1.0, 1), (1.0, 3), (1e3, 2), (1e-3, 2)):
        arrays = shell_arrays(0.9, scale=scale)
        cameras = cameras_around(8, radius=4.0 * scale)
        field = VacancyField(arrays, cameras, near_z=0.2 * scale, threads=threads)
        vectors = VectorField(arrays, threads=threads)
        results.append(project_to_isosurface(scale * starts, field, vectors, tolerance=5e-3))
    base, same, *scaled = results
    np.testing.assert_array_equal(base.points, same.points)
    np.testing.assert_array_equal(base.status, same.status)
    for scale, other in zip((1e3, 1e-3), scaled, strict=True):
        np.testing.assert_array_equal(other.on_surface, base.on_surface)
        gap = np.linalg.norm(other.points / scale - base.points, axis=1) / 0.005
        # Float32 rounding may take another branch; both ends then meet the same tolerance.
        assert np.quantile(gap, 0.9) < 0.01
        assert gap[base.on_surface].max() < 0.5


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_residuals_of_the_default_are_small_at_any_scale(scale: float) -> None:
    """99 % within 0.02 and the median within 0.002, from starts a sample apart (issue: PAM)."""
    arrays = shell_arrays(0.9, scale=scale)
    field = VacancyField(arrays, cameras_around(12, radius=4.0 * scale), near_z=0.2 * scale)
    starts = scale * around_shell(3000, 0.01, seed=4)
    result = project_to_isosurface(starts, field, VectorField(arrays))
    check_bookkeeping(result, TOLERANCE)
    assert result.on_surface.mean() > 0.999
    residual = result.residual[result.on_surface]
    # The stored residual is the field's own answer at the stored point.
    again = np.abs(field.vacancy(result.points[result.on_surface]).vacancy - 0.5)
    np.testing.assert_allclose(again, residual, atol=1e-6)
    assert np.quantile(residual, 0.99) <= 0.006
    assert np.median(residual) <= 0.002
