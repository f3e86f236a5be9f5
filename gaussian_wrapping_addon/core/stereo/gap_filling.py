# SPDX-License-Identifier: GPL-3.0-or-later
"""Points where stereo confirms nothing, so that training starts without holes.

See docs/method.md, section 11.8.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from .depth_maps import DepthMap
from .fusion import DensePoints, lifted, merged
from .open_cells import shown_open

MOST_COST = 0.7
"""A depth that no source confirms is a guess if it costs less; else nothing is known."""

UNCONFIRMED_WEIGHT = 0.2
"""Weight of a depth that no source confirms; each source adds as much."""

CLEARANCE = 0.5
"""Sizes of a point from confirmed ones within which it is left out."""

SEEN_THROUGH_SHARE = 0.03
"""A confirmed depth this much larger than a point's sees through the point."""

SEEN_THROUGH_VIEWS = 2
"""Views that must see through a point for it to be left out."""

OPEN_VIEWS = 2
"""Views that must show a point where nothing matches for it to be left out."""


def fill_gaps(depth_maps: Sequence[DepthMap], confirmed: DensePoints, wanted: int) -> DensePoints:
    """Return points from unconfirmed depths, away from confirmed points and from free space.

    Parameters
    ----------
    confirmed : DensePoints
    wanted : int
        Largest number of points, about.
    """
    weights = [_guessed(depth_map) for depth_map in depth_maps]
    guesses = merged(lifted(depth_maps, weights), wanted)
    if len(guesses) == 0 or len(confirmed) == 0:
        return guesses
    distance, nearest = cKDTree(confirmed.positions).query(guesses.positions)
    reach = CLEARANCE * np.maximum(guesses.sizes, confirmed.sizes[nearest])
    guesses = guesses.select(distance > reach)
    for against, views in ((seen_through, SEEN_THROUGH_VIEWS), (shown_open, OPEN_VIEWS)):
        guesses = guesses.select(count_views(guesses.positions, depth_maps, against) < views)
    return guesses


def count_views(
    points: np.ndarray,
    depth_maps: Sequence[DepthMap],
    against: Callable[[np.ndarray, DepthMap], np.ndarray],
) -> np.ndarray:
    """Count the views that speak against each point.

    Parameters
    ----------
    points : (n, 3) float64
        Scene frame.
    against : callable
        Returns the indices of the points that a view speaks against, each once.

    Returns
    -------
    (n,) int64
    """
    count = np.zeros(len(points), np.int64)
    for depth_map in depth_maps:
        count[against(points, depth_map)] += 1
    return count


def seen_through(points: np.ndarray, depth_map: DepthMap) -> np.ndarray:
    """Return the indices of the points (n, 3) with a view's confirmed depth clearly behind them."""
    shown, row, column, depth = depth_map.camera.shown(points)
    behind = depth_map.depth[row, column] > (1.0 + SEEN_THROUGH_SHARE) * depth
    found: np.ndarray = shown[behind & (depth_map.confidence[row, column] > 0)]
    return found


def _guessed(depth_map: DepthMap) -> np.ndarray:
    """Return (h, w) weights of the depths that are unconfirmed and yet better than nothing."""
    guess = (depth_map.confidence == 0) & ((depth_map.agreeing > 0) | (depth_map.cost < MOST_COST))
    if depth_map.mask is not None:
        guess &= depth_map.mask
    weight = UNCONFIRMED_WEIGHT * (1.0 + depth_map.agreeing)
    return np.where(guess, weight, 0.0).astype(np.float32)
