# SPDX-License-Identifier: GPL-3.0-or-later
"""Points and pixels of a camera."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.scenes import look_at

CAMERA = look_at((2.2, 1.0, 0.8), width=33, height=17)


def test_rays_at_the_centres_of_pixels_are_those_of_the_image() -> None:
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    pixels = np.stack([columns.ravel(), rows.ravel()], 1) + 0.5
    assert np.array_equal(CAMERA.rays_at(pixels), CAMERA.rays().reshape(-1, 3))


def test_points_on_rays_are_shown_where_the_rays_begin() -> None:
    pixels = np.random.default_rng(0).uniform((0.0, 0.0), (33.0, 17.0), (200, 2))
    depth = np.linspace(0.5, 4.0, 200)
    points = (CAMERA.rays_at(pixels) * depth[:, None]) @ CAMERA.rotation + CAMERA.center
    indices, row, column, found = CAMERA.shown(points)
    assert np.array_equal(indices, np.arange(200))
    assert np.array_equal(np.stack([column, row], 1), np.floor(pixels))
    assert np.allclose(found, depth, rtol=1e-12)


def test_points_outside_the_image_and_behind_the_camera_are_not_shown() -> None:
    pixels = np.array([[-0.1, 5.0], [5.0, -0.1], [33.1, 5.0], [5.0, 17.1], [5.0, 5.0], [6.5, 2.5]])
    depth = np.array([1.0, 1.0, 1.0, 1.0, -1.0, 1.0])
    points = (CAMERA.rays_at(pixels) * depth[:, None]) @ CAMERA.rotation + CAMERA.center
    indices, row, column, _ = CAMERA.shown(points)
    assert (indices.tolist(), row.tolist(), column.tolist()) == ([5], [2], [6])
    assert all(len(part) == 0 for part in CAMERA.shown(np.zeros((0, 3))))


@pytest.mark.parametrize(
    "change",
    [
        {"width": 0}, {"width": 64.0}, {"height": True}, {"height": 10**9}, {"fx": 0.0},
        {"fy": float("nan")}, {"cx": 10**400}, {"cy": "left"}, {"name": 5}, {"lens": "wide"},
        {"cam_from_world": [1.0, 2.0]}, {"cam_from_world": [[10**400] * 4] * 3},
        {"cam_from_world": [[float("inf")] * 4] * 3},
    ],
)  # fmt: skip
def test_values_that_no_camera_has_are_refused(change: dict[str, Any]) -> None:
    camera = Camera("a.png", 64, 48, 60.0, 61.0, 32.0, 24.0, np.eye(3, 4))
    values = camera.to_json()
    assert np.array_equal(Camera.from_json(values).cam_from_world, camera.cam_from_world)
    with pytest.raises((KeyError, TypeError, ValueError)):
        Camera.from_json({**values, **change})
