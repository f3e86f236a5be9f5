# SPDX-License-Identifier: GPL-3.0-or-later
"""Choose the pairs of photos to match."""

from __future__ import annotations

import numpy as np

EXHAUSTIVE_LIMIT = 150
"""Up to this many photos all pairs are matched (11 175 of them)."""
_NEIGHBOURS = 12
_KEYFRAMES = 80
_POSED_NEIGHBOURS = 14
_MAX_VIEW_ANGLE_COS = np.cos(np.radians(60.0))


def pairs_by_order(count: int) -> list[tuple[int, int]]:
    """Return pairs (i < j) of ``count`` photos sorted by name.

    Small sets: all pairs. Large sets: sequential neighbours, neighbours at powers of two, and all
    pairs of evenly spaced keyframes for loop closure.
    """
    if count <= EXHAUSTIVE_LIMIT:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    pairs: set[tuple[int, int]] = set()
    steps = [*range(1, _NEIGHBOURS + 1), *(2**k for k in range(4, count.bit_length()))]
    for i in range(count):
        pairs.update((i, i + step) for step in steps if i + step < count)
    keys = np.unique(np.linspace(0, count - 1, _KEYFRAMES).astype(int)).tolist()
    pairs.update((a, b) for n, a in enumerate(keys) for b in keys[n + 1 :])
    return sorted(pairs)


def pairs_by_pose(centers: np.ndarray, forwards: np.ndarray) -> list[tuple[int, int]]:
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
        cost[(angle_cos < _MAX_VIEW_ANGLE_COS) | (np.arange(len(centers)) == i)] = np.inf
        order = np.argsort(cost, kind="stable")[:_POSED_NEIGHBOURS]
        pairs.update((min(i, int(j)), max(i, int(j))) for j in order if np.isfinite(cost[j]))
    return sorted(pairs)
