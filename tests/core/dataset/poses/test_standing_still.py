# SPDX-License-Identifier: GPL-3.0-or-later
"""Recognising a still camera before a turning object by matches alone."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gaussian_wrapping_addon.core.poses.checks import (
    MIN_GROUP,
    PairMotion,
    are_turning,
    pair_motion,
    standing_groups,
)

SIZE = (640, 480)


def spread(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([20, 20], [620, 460], (count, 2))


def everywhere(count: int, *, is_still: bool, moved: int) -> list[PairMotion]:
    return [PairMotion(a, b, is_still, moved) for a, b in itertools.combinations(range(count), 2)]


def test_background_that_stays_and_an_object_that_moves() -> None:
    background, thing = spread(30), spread(25, 1)
    points = np.concatenate([background, thing])
    others = np.concatenate([background + 0.4, thing + np.array([40, 3])])
    found = pair_motion(3, 7, points, others, SIZE)
    assert found == PairMotion(3, 7, True, 25)


def test_a_moving_camera_leaves_nothing_in_its_place() -> None:
    points = spread(200)
    assert not pair_motion(0, 1, points, points + np.array([9, 0]), SIZE).is_still


def test_a_date_in_the_corner_is_no_background() -> None:
    date = np.random.default_rng(0).uniform([540, 440], [630, 470], (60, 2))
    points = np.concatenate([date, spread(100)])
    others = np.concatenate([date, spread(100) + np.array([30, 8])])
    assert not pair_motion(0, 1, points, others, SIZE).is_still


def test_a_bonnet_along_the_lower_edge_is_no_background() -> None:
    bonnet = np.random.default_rng(0).uniform([10, 430], [630, 475], (200, 2))
    world = spread(400)
    points, others = np.concatenate([bonnet, world]), np.concatenate([bonnet, world + 20.0])
    assert not pair_motion(0, 1, points, others, SIZE).is_still


def test_a_display_over_a_moving_picture_is_no_background() -> None:
    """Marks all over the picture stand still, between them everything moves."""
    marks, world = spread(40), spread(900, 1)
    points, others = np.concatenate([marks, world]), np.concatenate([marks, world + 20.0])
    assert not pair_motion(0, 1, points, others, SIZE).is_still


def test_what_moves_must_move_as_one() -> None:
    assert are_turning([30, 14, 12, 60])
    assert not are_turning([3, 0, 0, 40])
    assert not are_turning([])


def test_no_match_is_no_evidence() -> None:
    nothing = np.zeros((0, 2))
    assert pair_motion(0, 1, nothing, nothing, SIZE) == PairMotion(0, 1, False, 0)
    assert standing_groups(5, []) == []


def test_a_turntable_is_one_group() -> None:
    motions = everywhere(12, is_still=True, moved=40)
    assert standing_groups(12, motions) == [list(range(12))]


def test_a_camera_that_waits_is_no_turntable() -> None:
    assert standing_groups(12, everywhere(12, is_still=True, moved=3)) == []


def test_a_short_pause_on_a_walk_is_no_turntable() -> None:
    motions = [
        PairMotion(a, b, b < MIN_GROUP - 1, 40) for a, b in itertools.combinations(range(40), 2)
    ]
    assert standing_groups(40, motions) == []


def test_slow_steps_are_not_chained_to_one_place() -> None:
    """A slow orbit: neighbours hardly move, photos farther apart do."""
    motions = [PairMotion(a, b, b - a == 1, 40) for a, b in itertools.combinations(range(30), 2)]
    assert standing_groups(30, motions) == []


def test_waiting_on_the_way_while_somebody_walks_by_is_no_turntable() -> None:
    motions = [PairMotion(a, b, b < 10, 40) for a, b in itertools.combinations(range(21), 2)]
    assert standing_groups(21, motions) == []


@pytest.mark.parametrize("strays", [0, 4])
def test_two_places_are_two_groups(strays: int) -> None:
    count = 20 + strays
    motions = [
        PairMotion(a, b, b < 20 and a // 10 == b // 10, 40)
        for a, b in itertools.combinations(range(count), 2)
    ]
    assert standing_groups(count, motions) == [list(range(10)), list(range(10, 20))]
