# SPDX-License-Identifier: GPL-3.0-or-later
"""Points are triangulated exactly, with wrong observations left out and errors stated."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.units.control_points import triangulate
from tests.poses import look_at_pose


def ring(count: int, spread_deg: float = 120.0) -> list[Camera]:
    out = []
    for i in range(count):
        angle = np.radians(spread_deg) * i / max(count - 1, 1)
        eye = [4 * np.cos(angle), 4 * np.sin(angle), 1.0 + 0.3 * (i % 3)]
        out.append(Camera(str(i), 640, 480, 600, 610, 322, 236, look_at_pose(eye)))
    return out


POINT = np.array([0.2, -0.3, 0.4])


def pixels_of(cameras: list[Camera]) -> np.ndarray:
    return np.array([c.project(POINT[None])[0][0] for c in cameras])


def test_exact_observations_give_the_exact_point() -> None:
    cameras = ring(6)
    found = triangulate(cameras, pixels_of(cameras), threshold_px=3.0, noise_px=0.1)
    assert found is not None
    np.testing.assert_allclose(found.position, POINT, atol=1e-12)
    assert found.used.all()


def test_wrong_observations_are_left_out() -> None:
    cameras = ring(10)
    pixels = pixels_of(cameras)
    pixels[[1, 4, 7]] += [[40.0, 3.0], [-60.0, 20.0], [0.0, 90.0]]
    found = triangulate(cameras, pixels, threshold_px=3.0, noise_px=0.1)
    assert found is not None
    np.testing.assert_allclose(found.position, POINT, atol=1e-12)
    assert list(np.flatnonzero(~found.used)) == [1, 4, 7]
    assert found.residuals_px[4] == pytest.approx(np.hypot(60, 20))


def test_the_covariance_is_that_of_repeated_clicks() -> None:
    cameras, rng = ring(7), np.random.default_rng(0)
    exact = pixels_of(cameras)
    found = [
        triangulate(cameras, exact + rng.normal(0, 0.5, exact.shape), threshold_px=5, noise_px=0.5)
        for _ in range(300)
    ]
    scatter = np.cov(np.array([f.position for f in found if f is not None]).T)
    stated = np.mean([f.covariance for f in found if f is not None], axis=0)
    np.testing.assert_allclose(np.linalg.eigvalsh(scatter), np.linalg.eigvalsh(stated), rtol=0.4)


def test_what_cannot_be_triangulated() -> None:
    near = ring(4, spread_deg=0.5)[::3]  # at the same height
    assert triangulate(near, pixels_of(near), threshold_px=3.0, noise_px=0.1) is None
    assert triangulate(near[:1], pixels_of(near[:1]), threshold_px=3.0, noise_px=0.1) is None
    assert triangulate([], np.zeros((0, 2)), threshold_px=3.0, noise_px=0.1) is None
    apart = ring(3)
    wild = pixels_of(apart) + np.array([[0, 200.0], [0, -150.0], [0, 30.0]])
    assert triangulate(apart, wild, threshold_px=3.0, noise_px=0.1) is None


def test_points_behind_the_cameras_do_not_count() -> None:
    cameras = ring(2, spread_deg=20)
    # The rays diverge: they meet behind both cameras.
    pixels = np.array([[0.0, 240.0], [640.0, 240.0]])
    assert triangulate(cameras, pixels, threshold_px=1e4, noise_px=0.1) is None
