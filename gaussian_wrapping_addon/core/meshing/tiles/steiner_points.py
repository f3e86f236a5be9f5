# SPDX-License-Identifier: GPL-3.0-or-later
"""Steiner points on a jittered lattice, which bound empty balls and so make Delaunay cells local.

Surface points alone have empty balls as large as the solid: whether four of them form a Delaunay
tetrahedron may depend on points anywhere. With a lattice of Steiner points in and around the
region, every tetrahedron that has a corner in the region has a circumscribed ball of at most
:attr:`SteinerPoints.ball_radius`. Reason: if a ball were larger, the ball of that radius that
touches it from within at that corner would be empty as well; but its centre lies in the lattice,
whose nearest Steiner point, or the surface point for which that one was removed, is closer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...regions.convex_region import Region

JITTER_SHARE = 0.1
"""Largest jitter of a Steiner point along each axis, as a share of the lattice's side."""

FARTHEST_SHARE = float(np.sqrt(3.0) * (0.5 + JITTER_SHARE))
"""Greatest distance of a point in a cell from the cell's Steiner point, in sides."""

CLEARANCE_RADII = 8.0
"""Clearance of Steiner points from surface points, in local thinning radii. Where those leave a gap
(three radii wide for unlucky candidates), a ball from a Steiner point that reaches through it is so
flat that it dips less than a radius below the surface, and a thin plate stays whole (with 2.5 it
got holes)."""

CLEARANCE_CAP_RADII = 2.5
"""The same from cap points, which have no gaps."""

SIDES_PER_TILE = 16.0
"""Lattice sides along the side of a square with the area of a tile's surface."""

MIN_SIDE_RADII = 4.0
MAX_STEINER_POINTS = 400_000


@dataclass(frozen=True)
class SteinerPoints:
    """A jittered lattice in and around a region."""

    points: np.ndarray
    """(n, 3) float64."""
    ball_radius: float
    """Greatest radius of an empty ball that touches the region; see the module docstring."""


def lattice_side(region: Region, radius: float, area_per_tile: float) -> float:
    """Return the side of the lattice, large compared with the spacing and small with a tile."""
    side = max(MIN_SIDE_RADII * radius, float(np.sqrt(area_per_tile)) / SIDES_PER_TILE)
    low, high = region.bounds
    for _ in range(8):  # the lattice reaches about two sides beyond the region
        count = float(np.prod((high - low + 4.0 * side) / side))
        side *= max(1.0, count / MAX_STEINER_POINTS) ** (1 / 3)
    return side


def steiner_lattice(region: Region, side: float, clearance: float, seed: int) -> SteinerPoints:
    """Return the Steiner points before those near surface points are removed.

    Parameters
    ----------
    side : float
    clearance : float
        Greatest distance at which a surface point removes Steiner points.
    """
    ball_radius = 1.01 * (FARTHEST_SHARE * side + clearance)
    low, high = region.bounds[0] - ball_radius - side, region.bounds[1] + ball_radius + side
    counts = np.ceil((high - low) / side).astype(int)
    cells = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), -1)
    centers = low + (cells.reshape(-1, 3) + 0.5) * side  # (k, 3)
    jitter = np.random.default_rng(seed).uniform(-1.0, 1.0, centers.shape)
    # Every cell that intersects the covered body, even by a corner.
    covered = region.distance(centers) <= ball_radius + 0.5 * np.sqrt(3.0) * side
    return SteinerPoints((centers + JITTER_SHARE * side * jitter)[covered], ball_radius)


def outside_clearance(
    steiner_points: np.ndarray, points: np.ndarray, distances: np.ndarray
) -> np.ndarray:
    """Return which of (n, 3) Steiner points lie beyond their nearest point's (m,) clearance."""
    if len(points) == 0 or len(steiner_points) == 0:
        return np.ones(len(steiner_points), np.bool_)
    nearest, index = cKDTree(points).query(
        steiner_points, distance_upper_bound=float(distances.max())
    )
    found = np.isfinite(nearest)
    return np.asarray(~found | (nearest > distances[np.where(found, index, 0)]))
