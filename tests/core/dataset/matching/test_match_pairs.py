# SPDX-License-Identifier: GPL-3.0-or-later
"""Pairs by order, by distance and by pose."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.poses.matching import (
    all_pairs,
    nearest_pairs,
    pairs_by_name,
    pairs_by_pose,
    pairs_in_order,
)


def test_all_pairs() -> None:
    assert all_pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


def test_pairs_in_order_join_next_photos_and_far_ones() -> None:
    pairs = pairs_in_order(1000)
    assert pairs == sorted(set(pairs))
    steps = {j - i for i, j in pairs}
    assert steps == {*range(1, 13), 16, 32, 64, 128, 256, 512}
    assert len(pairs) == sum(1000 - step for step in steps)
    assert pairs_in_order(3) == [(0, 1), (0, 2), (1, 2)]


def test_pairs_by_name_are_few() -> None:
    assert pairs_by_name(5) == [
        (0, 1),
        (0, 2),
        (0, 3),
        (1, 2),
        (1, 3),
        (1, 4),
        (2, 3),
        (2, 4),
        (3, 4),
    ]


def test_nearest_pairs_are_the_smallest_distances_of_each() -> None:
    places = np.random.default_rng(3).uniform(size=(40, 2))
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    distances[7] = distances[:, 7] = np.inf  # unknown: no pair
    distances[8, 9] = distances[9, 8] = np.nan
    pairs = set(nearest_pairs(distances, 3))
    expected = set()
    for i in range(40):
        others = [j for j in range(40) if j != i and np.isfinite(distances[i, j])]
        nearest = sorted(others, key=lambda j: distances[i, j])[:3]
        expected |= {(min(i, j), max(i, j)) for j in nearest}
    assert pairs == expected


def test_pairs_by_pose_join_neighbours_that_look_alike() -> None:
    angles = np.arange(40) * 2 * np.pi / 40
    centers = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    pairs = pairs_by_pose(centers, -centers)
    assert {(i, i + 1) for i in range(39)} | {(0, 39)} <= set(pairs)
    assert all(min(j - i, 40 - j + i) <= 7 for i, j in pairs)
