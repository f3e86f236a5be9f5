# SPDX-License-Identifier: GPL-3.0-or-later
"""Which pairs of a large set are matched, in two rounds."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.poses.matching import (
    EXHAUSTIVE_LIMIT,
    SECOND_ROUND_PAIRS,
    VERIFIED_MATCHES,
    all_pairs,
    choose_pairs,
    pairs_in_order,
    second_round,
)

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
