# SPDX-License-Identifier: GPL-3.0-or-later
"""Which photos are compared: near enough to look alike, far enough apart to tell depths."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.matching import MOST_SOURCES, in_image, source_views
from tests.synthetic import look_at

POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (300, 3))


def around(angle_deg: float, distance: float = 4.0) -> Camera:
    angle = np.radians(angle_deg)
    center = distance * np.array([np.cos(angle), np.sin(angle), 0.0])
    return look_at(center, np.zeros(3), f"{angle_deg}", 64, 48, 80.0)


def test_neighbours_at_12_degrees_come_first() -> None:
    angles = [0, 2, 12, 40, 80, -12]
    sources = source_views([around(a) for a in angles], POINTS)[0]
    assert set(sources[:2]) == {2, 5}
    assert 0 not in sources
    assert list(sources).index(2) < list(sources).index(3)


def test_photos_of_the_same_scale_come_first() -> None:
    sources = source_views([around(0), around(12, 8.0), around(-12, 4.0)], POINTS)[0]
    assert sources[0] == 2


def test_there_are_no_more_than_a_byte_holds_and_each_once() -> None:
    cameras = [around(3.0 * i) for i in range(30)]
    for view, sources in enumerate(source_views(cameras, POINTS)):
        assert len(sources) == MOST_SOURCES == 8
        assert len(set(sources.tolist())) == len(sources)
        assert view not in sources


def test_photos_that_share_no_points_are_not_compared() -> None:
    away = look_at(np.array([4.0, 0, 0]), np.array([9.0, 0, 0]), "away", 64, 48, 80.0)
    sources = source_views([around(0), around(12), away], POINTS)
    assert [s.tolist() for s in sources] == [[1], [0], []]
    assert [len(s) for s in source_views([around(0), around(12)], np.zeros((0, 3)))] == [0, 0]
    assert [len(s) for s in source_views([around(0)], POINTS)] == [0]


def test_more_than_255_photos_have_sources() -> None:
    cameras = [around(360.0 * i / 300) for i in range(300)]
    sources = source_views(cameras, POINTS[:40])
    assert max(s.max() for s in sources) == 299
    angle = np.abs((sources[280] - 280 + 150) % 300 - 150) * 1.2
    assert angle.max() < 60.0


def test_points_in_the_image_lie_before_the_camera() -> None:
    camera = around(0)
    points = np.array([[0.0, 0, 0], [8.0, 0, 0], [3.9, 0, 0], [0, 5.0, 0]])
    inside, depth = in_image(camera, points)
    assert inside.tolist() == [True, False, False, False]
    assert depth == pytest.approx([4.0, -4.0, 0.1, 4.0])
