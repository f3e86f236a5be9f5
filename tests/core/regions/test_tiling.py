# SPDX-License-Identifier: GPL-3.0-or-later
"""Boxes that partition space, with even shares of a weight."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.regions.shapes import Tiling, split_evenly


def grid_tiling(places: tuple[float, ...]) -> Tiling:
    """Cut all tiles at the same coordinates of each axis: a grid with (n + 1)^3 cells."""
    splits: list[tuple[int, int, float]] = []
    for axis in range(3):
        rows = list(range(len(splits) + 1))
        for place in sorted(places, reverse=True):  # what remains lies below
            for tile in rows:
                splits.append((tile, axis, place))
    return Tiling(tuple(splits))


def test_every_point_has_one_owner_also_on_borders() -> None:
    tiling = grid_tiling((-0.5, 0.5))
    assert len(tiling) == 27
    ticks = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    points = np.stack(np.meshgrid(ticks, ticks, ticks), -1).reshape(-1, 3)
    owner = tiling.owner(points)
    for tile in range(len(tiling)):
        low, high = tiling.box(tile)
        inside = ((points >= low) & (points < high)).all(1)
        assert (inside == (owner == tile)).all()
    assert set(owner) == set(range(27))
    assert Tiling.from_json(tiling.to_json()) == tiling


def test_tiles_hold_even_shares_also_of_lumped_weight() -> None:
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(5000, 3)) ** 3
    weights = rng.uniform(size=5000)
    bounds = (centers.min(0), centers.max(0))
    tiling = split_evenly(centers, weights, bounds, lambda count, _: count >= 16)
    shares = np.bincount(tiling.owner(centers), weights, minlength=16) / weights.sum()
    assert shares.min() > 0.9 / 16
    assert shares.max() < 1.1 / 16
    by_weight = split_evenly(centers, weights, bounds, lambda _, most: most <= 100.0)
    assert np.bincount(by_weight.owner(centers), weights).max() <= 100.0
    # All in one place cannot be shared, but the cutting ends.
    lump = split_evenly(np.zeros((3, 3)), np.ones(3), bounds, lambda count, _: count >= 5)
    assert len(lump) == 5
    empty = split_evenly(np.zeros((0, 3)), np.zeros(0), bounds, lambda count, _: count >= 4)
    assert len(empty) == 4
