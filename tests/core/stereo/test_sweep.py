# SPDX-License-Identifier: GPL-3.0-or-later
"""Sweeps find the plane of photos of a plane, from random ones."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.stereo.matching import GOOD_COST, WORST_COST, MatchingLevel
from tests.core.stereo.textured_plane import (
    cameras,
    grey_photo,
    level_of,
    plane_photos,
    true_planes,
)

INSIDE = (slice(8, 40), slice(12, 56))
"""Pixels whose windows other photos show."""


def random_level(photos: list[np.ndarray] | None = None) -> MatchingLevel:
    given, own = plane_photos()
    level = level_of(list(own) if photos is None else photos, list(given))
    random = np.random.default_rng(3)
    for view in range(len(level)):
        planes = level.planes_of(view)
        planes[..., 0] = random.uniform(0.1, 0.6, planes.shape[:2])
    return level


def share_right(level: MatchingLevel, view: int = 1) -> float:
    truth = true_planes(level.cameras[view])[..., 0]
    return float((np.abs(level.planes_of(view)[..., 0] / truth - 1) < 0.01)[INSIDE].mean())


def test_more_sweeps_find_the_plane_in_more_pixels() -> None:
    level = random_level()
    shares = [share_right(level)]
    for turn in range(3):
        level.sweep(1, turn, 0, fresh=True)
        shares.append(share_right(level))
    assert shares[0] < 0.1
    assert shares == sorted(shares)
    assert shares[-1] > 0.9
    assert np.median(level.costs[1][INSIDE]) < 0.05
    slopes, truth = level.planes_of(1)[..., 1:], true_planes(level.cameras[1])[..., 1:]
    assert np.median(np.abs(slopes - truth)[INSIDE]) < 0.1 * np.abs(truth).max()


def test_equal_seeds_give_equal_planes() -> None:
    first, again, other = random_level(), random_level(), random_level()
    for level, seed in ((first, 5), (again, 5), (other, 6)):
        level.sweep(0, 0, seed, fresh=True)
    assert np.array_equal(first.planes, again.planes)
    assert np.array_equal(first.costs[0], again.costs[0])
    assert not np.array_equal(first.planes, other.planes)


@pytest.mark.parametrize("seed", [0, 2**31 - 1, 2**40])
def test_every_seed_is_taken(seed: int) -> None:
    level = random_level()
    level.sweep(1, 0, seed, fresh=True)
    assert share_right(level) > 0.2


def test_planes_stay_in_the_range_of_depths() -> None:
    level = random_level([np.full_like(photo, 128) for photo in plane_photos()[1]])
    for turn in range(2):
        level.sweep(1, turn, 0, fresh=True)
    depths = level.planes_of(1)[..., 0]
    assert depths.min() >= np.float32(0.03)
    assert depths.max() <= np.float32(0.6)
    assert level.costs[1].min() > 0.9


def test_the_prior_decides_where_there_is_no_texture() -> None:
    level = random_level([np.full_like(photo, 128) for photo in plane_photos()[1]])
    prior = true_planes(level.cameras[1]).astype(np.float32)
    prior[:, :20] = 0.0
    level.sweep(1, 0, 0, prior=prior)
    truth = prior[..., 0]
    right = np.abs(level.planes_of(1)[:, 20:, 0] / truth[:, 20:] - 1) < 0.005
    assert right.mean() > 0.95


def test_a_photo_without_sources_is_left_alone_and_matches_nothing() -> None:
    given, photos = plane_photos()
    level = MatchingLevel(given, photos, [np.zeros(0, int)] * 3, np.tile([0.1, 0.6], (3, 1)))
    level.planes[..., 0] = 0.3
    level.sweep(0, 0, 0, fresh=True)
    assert (level.planes[..., 0] == np.float32(0.3)).all()
    assert (level.costs[0] == WORST_COST).all()
    assert not level.confirm(0, level.inverse_depths()).any()
    assert not level.confirmed[0].any()


def test_one_source_is_enough_to_find_planes() -> None:
    given, photos = plane_photos()
    sources = [np.array([1]), np.array([0])]
    level = MatchingLevel(given[:2], photos[:2], sources, np.tile([0.1, 0.6], (2, 1)))
    level.planes[..., 0] = np.random.default_rng(0).uniform(0.1, 0.6, level.planes.shape[:3])
    for turn in range(3):
        level.sweep(1, turn, 0, fresh=True)
    assert share_right(level) > 0.7


def level_with_kept_sources(kept_photos: str) -> MatchingLevel:
    """Return true planes whose pixels of photo 2 kept the sources 0 and 1, of these photos."""
    given = cameras(5)
    photos = [grey_photo(camera) for camera in given]
    random = np.random.default_rng(4)
    for k in (0, 1):
        noisy = photos[k] + random.normal(0.0, 5.0, photos[k].shape)
        changed = noisy if kept_photos == "noisy" else random.uniform(0, 255, noisy.shape)
        photos[k] = np.clip(changed, 0, 255).astype(np.uint8)
    level = level_of(photos, given)
    level.planes_of(2)[:] = true_planes(given[2])
    level._best_sources[2][:] = 0b0011
    level.sweep(2, 0, 0)
    return level


SHOWN = (slice(12, 36), slice(26, 38))
"""Pixels whose windows all five photos show."""


def test_sources_that_were_good_enough_are_kept() -> None:
    """Unless a neighbour hands on better ones: pixels at the border had to look for others."""
    level = level_with_kept_sources("noisy")
    kept = (level._best_sources[2] == 0b0011)[SHOWN]
    assert kept.mean() > 0.1  # judged in all sources, a noisy one is hardly ever among the best
    assert level.costs[2][SHOWN][kept].max() < GOOD_COST


def test_other_sources_are_asked_where_those_that_were_kept_do_not_match() -> None:
    level = level_with_kept_sources("others")
    assert (level._best_sources[2] == 0b1100)[SHOWN].mean() > 0.9
    assert np.median(level.costs[2][SHOWN]) < 0.05
