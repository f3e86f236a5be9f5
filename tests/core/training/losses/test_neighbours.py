# SPDX-License-Identifier: GPL-3.0-or-later
"""Neighbouring cameras: limits, order, independence of other cameras."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings import preset
from gaussian_wrapping_addon.core.training.multi_view import NeighbourLimits, find_neighbours
from tests.core.render.scenes import look_at

RADIUS = limits.SCENE_RADIUS
PUBLISHED = NeighbourLimits.of_settings(preset("paper").training)


def turned(x: float, angle_deg: float) -> Camera:
    """Return a camera on the x axis, turned within the plane z = 0."""
    angle = np.radians(angle_deg)
    return look_at((x, 0.0, 0.0), (x + np.sin(angle), np.cos(angle), 0.0))


def listed(found: list[np.ndarray]) -> list[list[int]]:
    return [indices.tolist() for indices in found]


def test_nearest_first_ties_by_angle_then_index() -> None:
    cameras = [turned(0, 0), turned(1, 0), turned(0.5, 9), turned(-0.5, -5), turned(-0.5, 5)]
    assert find_neighbours(cameras)[0].tolist()[:2] == [3, 4]
    assert find_neighbours(cameras)[0].tolist() == [3, 4, 2, 1]


@pytest.mark.parametrize(
    ("camera", "counts"),
    [
        (turned(0.5, 29.9), True),
        (turned(0.5, 30.1), False),
        (turned(0.003 * RADIUS, 0), True),
        (turned(0.0019 * RADIUS, 0), False),
        (turned(0.29 * RADIUS, 0), True),
        (turned(0.31 * RADIUS, 0), False),
        (turned(0.5, 180), False),
    ],
)
def test_limits_of_the_method(camera: Camera, counts: bool) -> None:
    found = listed(find_neighbours([turned(0, 0), camera], PUBLISHED))
    assert found == ([[1], [0]] if counts else [[], []])


def test_default_reaches_across_a_sparse_ring() -> None:
    eyes = [(4.5 * np.cos(a), 4.5 * np.sin(a), 1.0) for a in np.linspace(0, 2 * np.pi, 18)[:-1]]
    cameras = [look_at(eye) for eye in eyes]  # 21 degrees, 0.33 radii apart
    assert all(len(found) == 0 for found in find_neighbours(cameras, PUBLISHED))
    for index, found in enumerate(find_neighbours(cameras)):
        assert sorted(found.tolist()) == sorted([(index - 1) % 17, (index + 1) % 17])


def test_a_camera_without_candidates_changes_no_other() -> None:
    close = [turned(0.1 * i, i) for i in range(12)]
    alone = find_neighbours(close)
    assert [len(found) for found in alone] == [8] * 12
    lonely = [turned(40.0, 0), turned(0.05, 180)]
    together = find_neighbours([*lonely, *close])
    assert listed(together[:2]) == [[], []]
    assert [(found - 2).tolist() for found in together[2:]] == listed(alone)


def test_few_are_kept_where_few_are_asked_for() -> None:
    cameras = [turned(0.1 * i, 0) for i in range(6)]
    assert find_neighbours(cameras, NeighbourLimits(most=2))[0].tolist() == [1, 2]


def test_images_of_other_points_do_not_count() -> None:
    cameras = [turned(0.0, 0), turned(0.4, 0), turned(4.0, 0)]
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 8), np.linspace(-0.3, 0.3, 8))
    near = np.stack([x.ravel(), np.full(64, 2.0), z.ravel()], 1)
    points = np.concatenate([near, near + np.array([4.0, 0.0, 0.0])])
    assert listed(find_neighbours(cameras)) == [[1, 2], [0, 2], [1, 0]]
    assert listed(find_neighbours(cameras, points=points)) == [[1], [0], []]
    # Too few points say nothing.
    assert listed(find_neighbours(cameras, points=points[:3])) == [[1, 2], [0, 2], [1, 0]]


def test_no_cameras() -> None:
    assert find_neighbours([]) == []
    assert listed(find_neighbours([turned(0, 0)])) == [[]]
