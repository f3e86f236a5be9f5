# SPDX-License-Identifier: GPL-3.0-or-later
"""Guesses stay where nothing is known, and go where photos see through them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gaussian_wrapping_addon.core.stereo.depth_maps import (
    DepthMap,
    count_views,
    fill_gaps,
    fuse,
    seen_through,
    shown_open,
)
from tests.core.stereo.ball_scene import arc_cameras, exact_map, surface_distance

EXACT = [exact_map(camera) for camera in arc_cameras()[4:8]]


def with_gap(depth_map: DepthMap, factor: float, cost: float = 0.5) -> DepthMap:
    """Return a map whose middle is a guess at ``factor`` times the depth."""
    gap = np.zeros(depth_map.depth.shape, bool)
    gap[30:60, 40:90] = True
    return dataclasses.replace(
        depth_map,
        depth=np.where(gap, factor * depth_map.depth, depth_map.depth).astype(np.float32),
        confidence=np.where(gap, 0, depth_map.confidence).astype(np.float32),
        agreeing=np.where(gap, 0, depth_map.agreeing).astype(np.uint8),
        cost=np.where(gap, cost, depth_map.cost).astype(np.float32),
    )


def test_guesses_away_from_confirmed_points_are_kept() -> None:
    gaps = [with_gap(m, 1.0) for m in EXACT]
    known = fuse(gaps, 3000)
    found = fill_gaps(gaps, known, 1500)
    assert len(found) > 50
    assert np.percentile(surface_distance(found.positions), 95) < 0.05
    distance = np.linalg.norm(found.positions[:, None] - known.positions[None], axis=2)
    near = distance <= 0.5 * np.maximum(found.sizes[:, None], known.sizes[None])
    nearest = distance.argmin(1)
    assert not near[np.arange(len(found)), nearest].any()


def test_guesses_where_photos_see_through_are_dropped() -> None:
    before = [with_gap(EXACT[0], 0.7), *EXACT[1:]]
    behind = [with_gap(EXACT[0], 1.0), *EXACT[1:]]
    nothing = fuse(EXACT, 10).select(np.zeros(0, int))
    some = fuse([EXACT[0]], 10).select(np.arange(1))
    assert len(fill_gaps(before, nothing, 500)) > 50  # without confirmed points all stay
    assert len(fill_gaps(before, some, 500)) < 0.1 * len(fill_gaps(behind, some, 500))


def test_guesses_near_confirmed_points_are_dropped() -> None:
    gaps = [with_gap(EXACT[0], 1.0), *EXACT[1:]]
    alone = fill_gaps(gaps, fuse(gaps, 10).select(np.arange(1)), 1000)
    beside = fill_gaps(gaps, fuse(EXACT, 8000), 1000)
    assert len(beside) < 0.5 * len(alone)


def test_guesses_where_nothing_matches_in_two_other_photos_are_dropped() -> None:
    """Where one photo shows them among what nothing explains, they stay."""
    some = fuse([EXACT[0]], 10).select(np.arange(1))
    kept, in_open = [], []
    for opened in range(4):
        costs = [0.5] + [0.9] * opened + [0.0] * (3 - opened)
        maps = [with_gap(m, 1.0, cost=c) for m, c in zip(EXACT, costs, strict=True)]
        found = fill_gaps(maps, some, 500)
        kept.append(len(found))
        in_open.append(count_views(found.positions, maps, shown_open).max())
    assert kept[1] > 50
    assert in_open == [0, 1, 1, 1]
    assert kept[3] < kept[2] < 0.8 * kept[1]


def test_where_nothing_matches_and_where_masks_exclude_nothing_is_guessed() -> None:
    nothing = fuse(EXACT, 10).select(np.zeros(0, int))
    assert len(fill_gaps([with_gap(EXACT[0], 1.0, cost=0.9)], nothing, 500)) == 0
    mask = np.zeros(EXACT[0].depth.shape, bool)
    masked = dataclasses.replace(with_gap(EXACT[0], 1.0), mask=mask)
    assert len(fill_gaps([masked], nothing, 500)) == 0
    assert len(fill_gaps([], nothing, 500)) == 0


@pytest.mark.parametrize(("share", "count"), [(0.9, 4), (0.99, 0), (1.0, 0), (1.2, 0)])
def test_views_that_see_through_points_are_counted(share: float, count: int) -> None:
    top = np.array([[0.0, 0.0, 1.0]])
    points = np.concatenate(
        [m.camera.center + share * (top - m.camera.center) for m in EXACT]
    )  # (4, 3), each on its own camera's ray
    own = [count_views(p[None], [m], seen_through)[0] for p, m in zip(points, EXACT, strict=True)]
    assert sum(own) == count


def test_points_outside_the_photos_are_not_seen_through() -> None:
    away = EXACT[0].camera.center - EXACT[0].camera.forward
    assert count_views(away[None], [EXACT[0]], seen_through).tolist() == [0]
    blind = dataclasses.replace(EXACT[0], confidence=np.zeros_like(EXACT[0].confidence))
    before = EXACT[0].camera.center + EXACT[0].camera.forward
    assert count_views(before[None], [EXACT[0], blind], seen_through).tolist() == [1]
