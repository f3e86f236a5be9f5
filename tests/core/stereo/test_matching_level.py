# SPDX-License-Identifier: GPL-3.0-or-later
"""Levels of photos of different sizes, and planes handed to the next finer one."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.stereo.matching import MatchingLevel, grey_levels
from tests.core.stereo.textured_plane import (
    HEIGHT,
    WIDTH,
    cameras,
    grey_photo,
    level_of,
    plane_photos,
    true_planes,
)


def test_grey_levels_are_the_luma() -> None:
    photo = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]], np.uint8)
    assert grey_levels(photo).tolist() == [[76, 150, 29, 255]]


def test_a_finer_level_starts_on_the_same_planes() -> None:
    given = list(plane_photos()[0])
    fine = level_of(list(plane_photos()[1]), given)
    halves = [camera.resized(WIDTH // 2, HEIGHT // 2) for camera in given]
    coarse = level_of([grey_photo(camera) for camera in halves], halves)
    for view, camera in enumerate(halves):
        coarse.planes_of(view)[:] = true_planes(camera)
        coarse.costs[view][:] = 0.25 + view
        fine.start_from(coarse, view)
        assert np.abs(fine.planes_of(view) / true_planes(given[view]) - 1).max() < 1e-4
        assert (fine.costs[view] == np.float32(0.25 + view)).all()


def test_photos_of_different_sizes_confirm_each_other() -> None:
    given = cameras()
    given[1] = given[1].resized(48, 36)
    given[2] = given[2].resized(31, 23)
    level = level_of([grey_photo(camera) for camera in given], given)
    assert level.planes.shape == (3, HEIGHT, WIDTH, 3)
    for view, camera in enumerate(given):
        level.planes_of(view)[:] = true_planes(camera)
    depths = level.inverse_depths()
    for view, camera in enumerate(given):
        means = level.confirm(view, depths)
        assert means.shape == (camera.height, camera.width)
        assert means == pytest.approx(true_planes(camera)[..., 0], rel=2e-3)
        assert (level.confirmed[view] == 3).mean() > 0.4


def test_sweeps_over_photos_of_different_sizes_find_the_plane() -> None:
    given = cameras()
    given[1] = given[1].resized(48, 36)
    level = level_of([grey_photo(camera) for camera in given], given)
    random = np.random.default_rng(0)
    level.planes[..., 0] = random.uniform(0.1, 0.6, level.planes.shape[:3])
    for turn in range(3):
        level.sweep(1, turn, 0, fresh=True)
    found, truth = level.planes_of(1)[..., 0], true_planes(given[1])[..., 0]
    assert (np.abs(found / truth - 1) < 0.01)[8:-8, 10:-10].mean() > 0.8
    assert (level.planes[1, 36:, :, 1:] == 0).all()  # beyond the photo


def test_photos_smaller_than_the_window_match_nothing() -> None:
    given = [camera.resized(7, 5) for camera in cameras()]
    level = MatchingLevel(
        given, [grey_photo(c) for c in given], [np.array([1, 2]), np.array([0]), np.array([0])],
        np.tile([0.1, 0.6], (3, 1)),
    )  # fmt: skip
    level.planes[..., 0] = 0.3
    for turn in range(3):
        level.sweep(0, turn, 0, fresh=True)
    assert level.costs[0].min() > 1.0
    assert np.isfinite(level.planes).all()
