# SPDX-License-Identifier: GPL-3.0-or-later
"""The gradient of log T against central differences of the definition, in float64."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gaussian_wrapping_addon.core.dataset.similarity import Similarity
from gaussian_wrapping_addon.core.field.vacancy.brute_force import log_transmittance
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from tests.core.field.field_scenes import (
    around_shell,
    cameras_around,
    make_arrays,
    random_arrays,
    shell_arrays,
    unit_sphere,
)


def numeric_gradient(
    arrays: GaussianArrays, center: np.ndarray, points: np.ndarray, step: float
) -> np.ndarray:
    """Return central differences of the definition's log T."""
    return np.stack(
        [
            log_transmittance(arrays, center, points + step * axis)
            - log_transmittance(arrays, center, points - step * axis)
            for axis in np.eye(3)
        ],
        1,
    ) / (2.0 * step)


def cloud_without_tails() -> GaussianArrays:
    """Return Gaussians so wide that no ray of the test passes their footprints' rim."""
    turned = random_arrays(40, seed=1).rotations
    return make_arrays(
        0.05 * unit_sphere(40), [0.3, 0.2, 0.25], np.linspace(0.2, 0.9, 40), rotations=turned
    )


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e4])
def test_gradient_equals_central_differences(scale: float) -> None:
    base = cloud_without_tails()
    arrays = dataclasses.replace(base, means=scale * base.means, scales=scale * base.scales)
    frame = Similarity(scale, np.eye(3), np.zeros(3))
    cameras = [camera.moved(frame) for camera in cameras_around(4)]
    field = VacancyField(arrays, cameras, near_z=0.2 * scale)
    points = 0.1 * scale * np.random.default_rng(0).normal(size=(200, 3))
    camera = np.arange(200) % 4
    got = field.log_gradient(points, camera)
    for index in range(4):
        rows = camera == index
        numeric = numeric_gradient(arrays, cameras[index].center, points[rows], 1e-6 * scale)
        size = np.linalg.norm(numeric, axis=1)
        gap = np.linalg.norm(got[rows] - numeric, axis=1)
        assert (gap <= 1e-6 * size + 1e-7 / scale).all()
        assert np.median(size) > 1.0 / scale
        # T falls along the ray.
        away = points[rows] - cameras[index].center
        assert ((got[rows] * away).sum(1) <= 1e-9).all()


def test_gradient_of_the_arg_max_camera_is_that_of_log_vacancy() -> None:
    """On the shell, up to the tails that the field drops on purpose."""
    arrays = shell_arrays(0.9)
    field = VacancyField(arrays, cameras_around(6))
    points = around_shell(600, 0.01)
    result = field.vacancy(points)
    rows = np.flatnonzero((result.vacancy > 0.2) & (result.vacancy < 0.8))
    assert len(rows) > 80
    got = field.log_gradient(points[rows], result.camera[rows])
    numeric = np.empty_like(got)
    for index, camera in enumerate(field.cameras):
        mine = result.camera[rows] == index
        numeric[mine] = numeric_gradient(arrays, camera.center, points[rows[mine]], 1e-7)
    size = np.linalg.norm(numeric, axis=1)
    gap = np.linalg.norm(got - numeric, axis=1)
    assert np.median(gap / size) < 0.01
    assert (gap / size).max() < 0.1
    outward = points[rows] / np.linalg.norm(points[rows], axis=1)[:, None]
    assert ((got * outward).sum(1) > 0.9 * np.linalg.norm(got, axis=1)).mean() > 0.95


def test_opaque_gaussians_and_points_that_the_camera_does_not_see() -> None:
    arrays = make_arrays(np.zeros(3), 0.1, 0.5)
    arrays.log_opacities[:] = 0.0
    field = VacancyField(arrays, cameras_around(2))
    seen = np.zeros((2, 3))
    assert np.isfinite(field.log_gradient(seen, np.array([0, 1]))).all()
    for point, camera in (([0.0, 0.0, 0.0], -1), ([50.0, 0.0, 0.0], 0), ([np.nan] * 3, 1)):
        assert (field.log_gradient(np.array([point]), np.array([camera])) == 0.0).all()
    assert field.log_gradient(np.zeros((0, 3)), np.zeros(0, np.int32)).shape == (0, 3)
    nothing = VacancyField(make_arrays(np.zeros((0, 3)), 0.1, 0.5), cameras_around(2))
    assert (nothing.log_gradient(seen, np.array([0, 1])) == 0.0).all()


def test_threads_change_nothing() -> None:
    arrays, points = shell_arrays(0.9, count=500), around_shell(3000, 0.02)
    camera = np.arange(3000) % 5
    one, three = (
        VacancyField(arrays, cameras_around(5), threads=n).log_gradient(points, camera)
        for n in (1, 3)
    )
    np.testing.assert_array_equal(one, three)
