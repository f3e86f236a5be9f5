# SPDX-License-Identifier: GPL-3.0-or-later
"""Which photos are matched: by order, distance, pose and resemblance."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.photos.exif import GpsPosition
from gaussian_wrapping_addon.core.poses.matching import (
    EXHAUSTIVE_LIMIT,
    SECOND_ROUND_PAIRS,
    VERIFIED_MATCHES,
    all_pairs,
    choose_pairs,
    gps_distances,
    nearest_pairs,
    pairs_by_name,
    pairs_by_pose,
    pairs_in_order,
    resemblances,
    second_round,
)


def test_pairs_in_order_join_next_photos_and_far_ones() -> None:
    pairs = pairs_in_order(1000)
    assert pairs == sorted(set(pairs))
    steps = {j - i for i, j in pairs}
    assert steps == {*range(1, 13), 16, 32, 64, 128, 256, 512}
    assert len(pairs) == sum(1000 - step for step in steps)
    assert pairs_in_order(3) == [(0, 1), (0, 2), (1, 2)]


def test_pairs_by_name_are_few() -> None:
    assert all_pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    assert pairs_by_name(5) == [pair for pair in all_pairs(5) if pair != (0, 4)]


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


def test_metres_on_the_ground() -> None:
    # A minute of latitude is 1853 m on a sphere of this radius; of longitude half of it at 60 deg.
    minute = 1 / 60
    here = GpsPosition(60.0, 10.0, 5.0)
    positions = [
        here, GpsPosition(60.0 + minute, 10.0, 900.0), None, GpsPosition(60.0, 10.0 + minute, None),
    ]  # fmt: skip
    metres = gps_distances(positions)
    np.testing.assert_array_equal(metres, metres.T)
    assert metres[0, 1] == pytest.approx(1853.25, abs=0.1)
    assert metres[0, 3] == pytest.approx(1853.25 / 2, abs=0.1)
    assert np.isinf(metres[2]).all()
    # The date line is no distance; too few or equal positions tell nothing.
    assert (
        gps_distances([GpsPosition(0.0, v, 0.0) for v in (179.999, -179.999, 179.998)]).max() < 400
    )
    for few in ([here, None, GpsPosition(48.1, 8.0, 0.0)], [here] * 5, [None] * 5):
        assert gps_distances(few) is None


COUNT = 400


def _shuffled_ring() -> tuple[np.ndarray, np.ndarray]:
    """Return angles of photos around a thing in any order, and their resemblance."""
    angles = np.random.default_rng(2).permutation(COUNT) * 2 * np.pi / COUNT
    return angles, np.cos(angles[:, None] - angles[None])


def _steps(angles: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
    """Return how many photos lie between the photos of each pair, on the ring."""
    i, j = np.array(pairs).T
    apart = np.rint(np.abs(angles[i] - angles[j]) * COUNT / (2 * np.pi)).astype(int)
    return np.minimum(apart, COUNT - apart)


def test_small_sets_are_matched_in_all_pairs() -> None:
    assert choose_pairs(EXHAUSTIVE_LIMIT) == all_pairs(EXHAUSTIVE_LIMIT)
    assert choose_pairs(40, in_order=True) == all_pairs(40)


def test_photos_that_resemble_each_other_are_matched_whatever_their_names() -> None:
    angles, alike = _shuffled_ring()
    pairs = choose_pairs(COUNT, resemblance=alike)
    assert pairs == sorted(set(pairs))
    assert all(0 <= i < j < COUNT for i, j in pairs)
    steps = _steps(angles, pairs)
    for step in range(1, 11):  # the 20 most alike are the 10 next on both sides
        assert (steps == step).sum() == COUNT
    assert len(pairs) < COUNT * 14


def test_order_has_loops_closed_by_resemblance() -> None:
    angles = np.arange(COUNT) * 2 * np.pi / COUNT
    alike = np.cos(angles[:, None] - angles[None])
    pairs = set(choose_pairs(COUNT, in_order=True, resemblance=alike))
    assert set(pairs_in_order(COUNT)) <= pairs
    assert {(0, COUNT - 1), (0, COUNT - 4), (3, COUNT - 1)} <= pairs


def test_gps_adds_pairs_and_never_takes_any_away() -> None:
    angles, alike = _shuffled_ring()
    without = set(choose_pairs(COUNT, resemblance=alike))
    chance = np.random.default_rng(1)
    wrong = chance.uniform(0, 50, (COUNT, 2))
    metres = np.linalg.norm(wrong[:, None] - wrong[None], axis=2)
    assert without < set(choose_pairs(COUNT, resemblance=alike, metres=metres))
    right = 10.0 * np.stack([np.cos(angles), np.sin(angles)], 1)
    metres = np.linalg.norm(right[:, None] - right[None], axis=2)
    by_gps = choose_pairs(COUNT, metres=metres)
    steps = _steps(angles, by_gps)
    for step in range(1, 6):
        assert (steps == step).sum() == COUNT
    assert (steps > 7).any()  # far ones, for loops


def test_the_second_round_connects_what_is_apart() -> None:
    count = 200
    tried = [(i, i + 1) for i in range(count - 1)]
    # Two halves, well connected each, without a verified pair between them.
    verified = {
        (i, j): 100
        for i in range(count)
        for j in range(i + 1, min(i + 6, count))
        if (i < 100) == (j < 100)
    }
    resemblance = np.zeros((count, count))
    resemblance[150, 20] = resemblance[20, 150] = 0.9
    more = second_round(count, tried, verified, resemblance)
    assert not set(more) & set(tried)
    assert (20, 150) in more
    # Photos 100 to 199 are not the largest part: each looks in the other.
    assert {j for i, j in more if i < 100 <= j} == set(range(100, 200))


def test_the_second_round_asks_neighbours_of_neighbours() -> None:
    count = 200
    tried = sorted({(i, i + 1) for i in range(count - 1)})
    verified = dict.fromkeys(tried, VERIFIED_MATCHES)
    more = second_round(count, tried, verified, np.zeros((count, count)))
    assert {(i, i + 2) for i in range(count - 2)} <= set(more)
    assert len(more) <= SECOND_ROUND_PAIRS * count
    assert more == second_round(count, tried, verified, np.zeros((count, count)))


def test_well_connected_photos_have_no_second_round() -> None:
    count = 160
    verified = {(i, j): 50 for i in range(count) for j in range(i + 1, count)}
    assert second_round(count, sorted(verified), verified, np.zeros((count, count))) == []


PHOTOS, EACH, STEP = 30, 200, 40


def _walk() -> list[np.ndarray]:
    """Return descriptors of photos of which neighbours share features, four fifths of them."""
    chance = np.random.default_rng(5)
    world = chance.gamma(0.4, 60.0, (STEP * PHOTOS + EACH, 128))
    photos = []
    for number in range(PHOTOS):
        seen = world[number * STEP : number * STEP + EACH]
        noisy = seen + chance.normal(0.0, 12.0, seen.shape)
        photos.append(noisy.clip(0, 255).astype(np.uint8)[chance.permutation(EACH)])
    return photos


def test_the_most_alike_share_most_features() -> None:
    photos = _walk()
    alike = resemblances(PHOTOS, lambda k: photos[k], seed=0)
    np.testing.assert_array_equal(alike, resemblances(PHOTOS, lambda k: photos[k], seed=0))
    np.testing.assert_allclose(np.diag(alike), 1.0, atol=1e-5)
    np.fill_diagonal(alike, -2.0)
    assert (np.abs(alike.argmax(1) - np.arange(PHOTOS)) == 1).all()
    far = np.abs(np.arange(PHOTOS)[:, None] - np.arange(PHOTOS)) >= 5  # nothing in common
    for number in range(PHOTOS):
        beside = [k for k in (number - 1, number + 1) if 0 <= k < PHOTOS]
        assert alike[number, beside].min() > alike[number, far[number]].max()


def test_photos_without_features_resemble_none() -> None:
    photos = _walk()
    photos[3] = np.zeros((0, 128), np.uint8)
    alike = resemblances(PHOTOS, lambda k: photos[k], seed=0)
    assert not alike[3].any()
    assert np.isfinite(alike).all()
    empty = [np.zeros((0, 128), np.uint8)] * 4
    assert not resemblances(4, lambda k: empty[k], seed=0).any()
