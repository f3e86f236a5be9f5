# SPDX-License-Identifier: GPL-3.0-or-later
"""Plane hypotheses against vectors, cameras and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.stereo.matching import (
    MAX_BACK_ERROR_PX,
    back_error_px,
    normal_of,
    random_share,
    slopes_of,
)
from tests.core.stereo.textured_plane import (
    HEIGHT,
    NORMAL,
    WIDTH,
    level_of,
    plane_photos,
    true_planes,
)

LENS = np.array([90.0, 110.0, 31.5, 20.0])


def test_normal_and_slopes_are_inverse_of_each_other() -> None:
    random = np.random.default_rng(0)
    for _ in range(200):
        u, v = random.uniform(0, 60, 2)
        w, (a, b) = random.uniform(0.1, 2.0), random.normal(size=2) * 0.01
        *normal, cosine = normal_of.py_func(u, v, w, a, b, LENS)
        ray = np.array([(u - LENS[2]) / LENS[0], (v - LENS[3]) / LENS[1], 1.0])
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        assert cosine == pytest.approx(np.dot(normal, ray) / np.linalg.norm(ray))
        assert slopes_of.py_func(u, v, w, *normal, LENS) == pytest.approx((a, b), abs=1e-12)


def test_the_normal_is_that_of_the_plane() -> None:
    (camera, *_), photos = plane_photos()
    lens = level_of(list(photos), list(plane_photos()[0])).lenses[0].astype(float)
    w, a, b = true_planes(camera)[13, 40]
    normal = np.array(normal_of.py_func(40.0, 13.0, w, a, b, lens)[:3])
    assert normal @ camera.rotation == pytest.approx(-NORMAL, abs=1e-6)


def test_maps_agree_with_the_projection_of_the_cameras() -> None:
    given, photos = plane_photos()
    level = level_of(list(photos), list(given))
    points = np.random.default_rng(1).uniform(-1, 1, (300, 3))
    pixels, depth = given[0].project(points)
    homogeneous = np.concatenate([pixels - 0.5, np.ones((300, 1))], 1)
    maps, back_maps, sizes, bases = level._joined[0]
    for s, source in enumerate(level.sources[0]):
        there, depth_there = given[source].project(points)
        mapped = homogeneous @ maps[s, :9].reshape(3, 3).T + maps[s, 9:] / depth[:, None]
        assert np.abs(mapped[:, :2] / mapped[:, 2:] - (there - 0.5)).max() < 1e-4
        assert mapped[:, 2] * depth == pytest.approx(depth_there, rel=1e-5)
        back = np.concatenate([there - 0.5, np.ones((300, 1))], 1)
        back = back @ back_maps[s, :9].reshape(3, 3).T + back_maps[s, 9:] / depth_there[:, None]
        assert np.abs(back[:, :2] / back[:, 2:] - (pixels - 0.5)).max() < 1e-4
        assert tuple(sizes[s]) == (WIDTH - 1, HEIGHT - 1)
        assert bases[s] == source * WIDTH * HEIGHT


def test_the_back_error_is_0_for_consistent_depths_and_else_the_shift() -> None:
    given, photos = plane_photos()
    level = level_of(list(photos), list(given))
    for view, camera in enumerate(given):
        level.planes_of(view)[:] = true_planes(camera)
    _, back_maps, _, bases = level._joined[0]
    x, y = 30.0, 20.0
    place = given[1].rays()[20, 30] / true_planes(given[1])[20, 30, 0]
    world = (place - given[1].cam_from_world[:, 3]) @ given[1].rotation
    u, v = given[0].project(world[None])[0][0] - 0.5

    def error(factor: float) -> float:
        depths = level.inverse_depths() * np.float32(factor)
        return float(
            back_error_px.py_func(0, u, v, x, y, back_maps, depths, bases[0], np.float32(WIDTH))
        )

    assert error(1.0) < 1e-3
    moved = (place / 1.02 - given[1].cam_from_world[:, 3]) @ given[1].rotation
    shift = np.linalg.norm(given[0].project(moved[None])[0][0] - 0.5 - (u, v))
    assert 0.1 < shift < 2.0
    assert error(1.02) == pytest.approx(shift, abs=1e-3)
    assert error(0.0) == error(-1.0) == error(5.0) == MAX_BACK_ERROR_PX


def test_random_shares_are_even() -> None:
    state = np.array([7], np.uint32)
    with np.errstate(over="ignore"):
        shares = np.array([random_share.py_func(state) for _ in range(4000)])
    assert shares.min() >= 0.0
    assert shares.max() < 1.0
    counts = np.histogram(shares, 10, (0, 1))[0]
    assert np.abs(counts - 400).max() < 90
    assert abs(np.corrcoef(shares[:-1], shares[1:])[0, 1]) < 0.06
