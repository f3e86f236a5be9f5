# SPDX-License-Identifier: GPL-3.0-or-later
"""Points that fill space, so that no empty ball is large and a tetrahedron is known from nearby.

Surface points alone have empty balls as large as the solid: whether four of them make a Delaunay
tetrahedron may depend on points anywhere. With a lattice of Steiner points through the region and
around it, every tetrahedron that has a corner in the region has a circumscribed ball of at most
:attr:`SteinerPoints.ball_radius`. Reason: were a ball larger, the ball of that radius that touches
it from within at that corner would be empty as well; its centre lies in the lattice, whose next
Steiner point, or the point that this one gave way to, is nearer than that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...regions.convex_region import Region

JITTER_SHARE = 0.1
"""Fillers are at most this share of the lattice's side off their places, along each axis."""

FARTHEST_SHARE = float(np.sqrt(3.0) * (0.5 + JITTER_SHARE))
"""No point of a cell is farther from its filler, in sides."""

CLEARANCE_RADII = 8.0
"""Fillers keep this many local thinning radii away from surface points. Where those leave a gap,
three radii wide on unlucky candidates, a ball from a filler that reaches through it is so flat that
it dips less than a radius below the surface, and a thin plate stays whole (with 2.5 it got holes).
"""

CLEARANCE_CAP_RADII = 2.5
"""The same of the region's boundary: its points have no gaps."""

SIDES_PER_TILE = 16.0
"""Lattice sides along the side of a square as large as a tile's part of the surface."""

MIN_SIDE_RADII = 4.0
MAX_STEINER_POINTS = 400_000


@dataclass(frozen=True)
class SteinerPoints:
    """A jittered lattice through a region and around it."""

    points: np.ndarray
    """(n, 3) float64."""
    ball_radius: float
    """Largest radius of an empty ball that touches the region; see the module."""


def lattice_side(region: Region, radius: float, area_per_tile: float) -> float:
    """Return the side of the lattice: coarse against the spacing, fine against a tile."""
    side = max(MIN_SIDE_RADII * radius, float(np.sqrt(area_per_tile)) / SIDES_PER_TILE)
    low, high = region.bounds
    for _ in range(8):  # the lattice reaches about two sides beyond the region
        count = float(np.prod((high - low + 4.0 * side) / side))
        side *= max(1.0, count / MAX_STEINER_POINTS) ** (1 / 3)
    return side


def steiner_lattice(region: Region, side: float, clearance: float, seed: int) -> SteinerPoints:
    """Return the fillers before any gives way.

    Parameters
    ----------
    side : float
    clearance : float
        Largest distance at which a point makes fillers give way.
    """
    ball_radius = 1.01 * (FARTHEST_SHARE * side + clearance)
    low, high = region.bounds[0] - ball_radius - side, region.bounds[1] + ball_radius + side
    counts = np.ceil((high - low) / side).astype(int)
    cells = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), -1)
    centers = low + (cells.reshape(-1, 3) + 0.5) * side  # (k, 3)
    jitter = np.random.default_rng(seed).uniform(-1.0, 1.0, centers.shape)
    # Of each cell that holds a point of the covered body, also where only its corner does.
    covered = region.distance(centers) <= ball_radius + 0.5 * np.sqrt(3.0) * side
    return SteinerPoints((centers + JITTER_SHARE * side * jitter)[covered], ball_radius)


def outside_clearance(
    steiner_points: np.ndarray, points: np.ndarray, distances: np.ndarray
) -> np.ndarray:
    """Tell which of (n, 3) fillers are farther from their nearest point than its (m,) distance."""
    if len(points) == 0 or len(steiner_points) == 0:
        return np.ones(len(steiner_points), np.bool_)
    nearest, index = cKDTree(points).query(
        steiner_points, distance_upper_bound=float(distances.max())
    )
    found = np.isfinite(nearest)
    return np.asarray(~found | (nearest > distances[np.where(found, index, 0)]))
