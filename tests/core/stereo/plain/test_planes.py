# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes in photos and through points."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.stereo.plane_fitting import (
    Plane,
    fit_plane,
    image_plane,
    lifted_pixels,
    pooled,
    refined,
    with_ones,
)
from tests.core.stereo.plain.plain_room import WALL, WALL_Y, cameras, traced


def wall_plane(offset: float = WALL_Y, support: float = 10.0, view: int = 0) -> Plane:
    random = np.random.default_rng(view)
    points = np.stack(
        [random.uniform(-2, 2, 400), np.full(400, offset), random.uniform(0, 2, 400)], 1
    )
    return Plane(
        np.array([0.0, 1.0, 0.0]), offset, points.mean(0), points, np.full(400, 0.1), support,
        frozenset([view]), 3.5,
    )  # fmt: skip


def test_inverse_depths_of_a_plane_are_linear_in_the_pixel() -> None:
    for camera in cameras():
        depth, part, points = traced(camera)
        row, column = np.nonzero(part == WALL)
        pixels = np.stack([column, row], 1).astype(float)
        inverse = with_ones(pixels) @ image_plane(wall_plane(), camera)
        assert np.abs(inverse * depth[row, column] - 1.0).max() < 1e-9
        lifted = lifted_pixels(camera, pixels, inverse)
        assert np.abs(lifted - points[row, column]).max() < 1e-9


def test_least_squares_and_robust_fit() -> None:
    exact = wall_plane()
    normal, offset, _ = fit_plane(exact.points, exact.weights)
    assert abs(normal[1]) > 1 - 1e-12
    assert abs(abs(offset) - WALL_Y) < 1e-9
    points = exact.points.copy()
    points[:120, 1] -= np.random.default_rng(0).uniform(0.05, 0.4, 120)  # 30 % lie before the wall
    start = Plane(
        np.array([0.0, np.cos(0.01), np.sin(0.01)]), 0.99 * WALL_Y, exact.center, points,
        exact.weights, 10.0, exact.views, 3.5,
    )  # fmt: skip
    found = refined(start)
    assert abs(found.normal[1]) > 1 - 1e-5
    assert abs(found.normal @ [0.0, WALL_Y, 1.0] - found.offset) < 2e-3


def test_equal_planes_of_several_photos_become_one() -> None:
    same = [wall_plane(WALL_Y + 0.01 * view, 10.0 + view, view) for view in range(3)]
    other = wall_plane(WALL_Y + 0.5, 5.0, 4)
    found = pooled([*same, other])
    assert len(found) == 2
    assert found[0].views == {0, 1, 2}
    assert found[0].support == sum(plane.support for plane in same)
    assert abs(abs(found[0].offset) - WALL_Y) < 0.02
    assert found[1].views == {4}


def test_a_moved_plane_keeps_its_evidence() -> None:
    plane = wall_plane()
    moved = plane.moved(np.array([1.0, 0.0, 0.0]), 2.0)
    assert (moved.offset, moved.views, moved.support) == (2.0, plane.views, plane.support)
    assert moved.points is plane.points
