# SPDX-License-Identifier: GPL-3.0-or-later
"""Pairs of photos by their order, and by known poses."""

from __future__ import annotations

import numpy as np

Pairs = list[tuple[int, int]]
"""Sorted, without repetition, (i, j) with i < j."""

EXHAUSTIVE_LIMIT = 150
"""Up to this many photos all pairs are matched (11 175 of them)."""
_ORDER_NEIGHBOURS = 12
_NAME_NEIGHBOURS = 3
"""Neighbours by name where the order is not known to mean anything."""
_POSED_NEIGHBOURS = 14
_SAME_PLACE = 1e-9
"""Distance of photos from one place over the typical one: rounding of their poses."""
_MAX_VIEW_ANGLE_COS = np.cos(np.radians(60.0))


def all_pairs(count: int) -> Pairs:
    """Return all pairs of ``count`` photos."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def pairs_in_order(count: int) -> Pairs:
    """Return pairs of photos taken one after the other, as of a video.

    Each with the 12 next ones, and with those 16, 32, 64, ... later.
    """
    steps = [*range(1, _ORDER_NEIGHBOURS + 1), *(2**k for k in range(4, count.bit_length()))]
    return sorted((i, i + step) for step in steps for i in range(count - step))


def pairs_by_name(count: int) -> Pairs:
    """Return each photo with the next ones by name, which mostly were taken next."""
    steps = range(1, _NAME_NEIGHBOURS + 1)
    return sorted((i, i + step) for step in steps for i in range(count - step))


def nearest_pairs(distances: np.ndarray, nearest: int) -> Pairs:
    """Return each item with its ``nearest`` others.

    Parameters
    ----------
    distances : (n, n) array
        Symmetric; infinite or not a number where unknown. Of equal ones the first is taken.
    """
    known = np.where(np.isfinite(distances), distances, np.inf)
    np.fill_diagonal(known, np.inf)
    order = np.argsort(known, axis=1, kind="stable")[:, :nearest]
    return sorted(
        {
            (min(i, j), max(i, j))
            for i, row in enumerate(order.tolist())
            for j in row
            if np.isfinite(known[i, j])
        }
    )


def pairs_by_pose(centers: np.ndarray, forwards: np.ndarray) -> Pairs:
    """Return pairs (i < j) of posed photos with similar positions and viewing directions.

    Parameters
    ----------
    centers, forwards : (n, 3) float64
        Camera centres and unit viewing directions.
    """
    pairs: set[tuple[int, int]] = set()
    typical = max(float(np.linalg.norm(centers - centers.mean(0), axis=1).mean()), 1e-12)
    for i in range(len(centers)):
        angle_cos = forwards @ forwards[i]
        cost = np.linalg.norm(centers - centers[i], axis=1) / typical + (1.0 - angle_cos)
        # Photos from one place, as the views of a panorama, tell no depth (the photo itself, too).
        same_place = np.linalg.norm(centers - centers[i], axis=1) <= _SAME_PLACE * typical
        cost[(angle_cos < _MAX_VIEW_ANGLE_COS) | same_place] = np.inf
        order = np.argsort(cost, kind="stable")[:_POSED_NEIGHBOURS]
        pairs.update((min(i, int(j)), max(i, int(j))) for j in order if np.isfinite(cost[j]))
    return sorted(pairs)
