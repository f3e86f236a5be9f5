# SPDX-License-Identifier: GPL-3.0-or-later
"""Tiles of a large region, and the Steiner points that make them independent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ... import limits
from ...mesh.sampling import POINTS_PER_SQUARE
from ...mesh.surface_mesh import area_vectors
from ...progress import Progress, ReportWarning
from ...regions.shapes import Region, Tiling, split_evenly
from ...scene.camera import Camera
from ..spacing import ResolutionRequest, Spacing, dense_request, nominal_edge
from ..surface_points import CandidateSurface, Caps, Field, SurfaceSampler, cap_points

# -- Steiner points on a jittered lattice, which bound empty balls and so make Delaunay cells
#    local
#
# Surface points alone have empty balls as large as the solid: whether four of them form a
# Delaunay tetrahedron may depend on points anywhere. With a lattice of Steiner points in and
# around the region, every tetrahedron that has a corner in the region has a circumscribed ball of
# at most :attr:`SteinerPoints.ball_radius`. Reason: if a ball were larger, the ball of that
# radius that touches it from within at that corner would be empty as well; but its centre lies in
# the lattice, whose nearest Steiner point, or the surface point for which that one was removed,
# is closer.

STEINER_POINTS_JITTER_SHARE = 0.1
"""Largest jitter of a Steiner point along each axis, as a share of the lattice's side."""

FARTHEST_SHARE = float(np.sqrt(3.0) * (0.5 + STEINER_POINTS_JITTER_SHARE))
"""Greatest distance of a point in a cell from the cell's Steiner point, in sides."""

CLEARANCE_RADII = 8.0
"""Clearance of Steiner points from surface points, in local thinning radii. Where those leave a gap
(three radii wide for unlucky candidates), a ball from a Steiner point that reaches through it is so
flat that it dips less than a radius below the surface, and a thin plate stays whole (with 2.5 it
got holes)."""

CLEARANCE_CAP_RADII = 2.5  # the same from cap points, which have no gaps
SIDES_PER_TILE = 16.0  # lattice sides along the side of a square with the area of a tile's surface

MIN_SIDE_RADII = 4.0
MAX_STEINER_POINTS = 400_000


@dataclass(frozen=True)
class SteinerPoints:
    """A jittered lattice in and around a region."""

    points: np.ndarray  # (n, 3) float64
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

    A surface point will remove those up to ``clearance`` away.
    """
    ball_radius = 1.01 * (FARTHEST_SHARE * side + clearance)
    low, high = region.bounds[0] - ball_radius - side, region.bounds[1] + ball_radius + side
    counts = np.ceil((high - low) / side).astype(int)
    cells = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), -1)
    centers = low + (cells.reshape(-1, 3) + 0.5) * side  # (k, 3)
    jitter = np.random.default_rng(seed).uniform(-1.0, 1.0, centers.shape)
    # Every cell that intersects the covered body, even by a corner.
    covered = region.distance(centers) <= ball_radius + 0.5 * np.sqrt(3.0) * side
    points = centers + STEINER_POINTS_JITTER_SHARE * side * jitter
    return SteinerPoints(points[covered], ball_radius)


def outside_clearance(
    steiner_points: np.ndarray, points: np.ndarray, distances: np.ndarray
) -> np.ndarray:
    """Return which of (n, 3) Steiner points lie beyond their nearest point's (m,) clearance."""
    if len(points) == 0 or len(steiner_points) == 0:
        return np.ones(len(steiner_points), np.bool_)
    farthest = float(distances.max())
    nearest, index = cKDTree(points).query(steiner_points, distance_upper_bound=farthest)
    found = np.isfinite(nearest)
    return np.asarray(~found | (nearest > distances[np.where(found, index, 0)]))


# -- Plan of a tiled mesh: the candidate surface, spacing, borders and Steiner points of all tiles

TILE_POINTS = 75_000
"""Most surface points of a tile if the number of tiles is automatic: its memory stays small
compared with the field's, and machines with several cores get enough tiles to distribute."""

WHOLE_POINTS = 400_000
"""Regions with at most this many surface points are meshed without tiles, memory permitting."""

JITTER_SHARE = 1e-6
"""Perturbation of all points, as a share of the region's diagonal, for the triangulation: that of
delaunay.JITTER_SHARE with its bounding points. Tiles must agree on it."""


@dataclass(frozen=True)
class TilePlan:
    """Data shared by all tiles, fixed before any tile is meshed."""

    region: Region
    surface: CandidateSurface
    area: float  # area of the candidate surface in the region
    spacing: Spacing
    """Local thinning radii of the whole surface; with adaptive spacing, of the dense mesh."""
    tiling: Tiling
    steiner_points: np.ndarray
    """(k, 3) float64, before those near surface points are removed. Stored as ``fillers``."""
    ball_radius: float
    """Greatest radius of an empty ball that touches the region. Stored as ``ball``."""
    caps: Caps
    seed: int
    notes: tuple[ReportWarning, ...]
    edge_length: float  # edge length of the uniform mesh that meets the request
    target: int
    share: float  # vertices to keep, as for :func:`.primal_adaptive.simplified`: 0 and 1 keep all
    depth_samples: int = 0

    @property
    def radius(self) -> float:
        """Largest thinning radius."""
        return float(self.spacing.radii.max())

    @property
    def halo(self) -> float:
        """Width of the neighbourhood that determines a tile's tetrahedra exactly.

        A tetrahedron with a corner in the tile has a circumscribed ball of at most ``ball_radius``
        through that corner, so points in that ball are at most its diameter away, plus the
        perturbation.
        """
        return 2.0 * self.ball_radius + 2.0 * JITTER_SHARE * self.region.diagonal


class _CapSpacing(Spacing):
    """Spacing that does not grow inside a cap, whose points bound the empty balls there."""

    def at(self, where: np.ndarray, threads: int = 1) -> np.ndarray:
        return np.minimum(super().at(where, threads), self.radii.max())


def make_plan(
    field: Field, region: Region, surface: CandidateSurface, request: ResolutionRequest,
    progress: Progress, *,
    tiles: int, seed: int, cameras: Sequence[Camera], adaptive: bool, depth_samples: int,
) -> TilePlan:  # fmt: skip
    """Compute the data that tiles share; 0 ``tiles`` stand for :data:`TILE_POINTS` in each.

    Raises ResourceError: the request needs more points than the limit.
    """
    rng = np.random.default_rng(seed)
    sampler = SurfaceSampler(field, region, surface, cameras if adaptive else ())
    dense = dense_request(request, sampler.area, region, adaptive=adaptive)
    spacing, notes = sampler.spacing(dense.request, rng)
    centers = surface.vertices[surface.faces].mean(1)
    cross = area_vectors(surface.vertices, surface.faces)
    expected = POINTS_PER_SQUARE * spacing.at(centers, field.threads) ** -2.0
    expected *= 0.5 * np.linalg.norm(cross, axis=1) * region.contains(centers)  # (f,) points

    def enough(count: int, heaviest: float) -> bool:
        if tiles > 0:
            return count >= tiles
        return heaviest <= TILE_POINTS or count >= limits.MAX_TILES

    tiling = split_evenly(centers, expected, region.bounds, enough)
    on_caps = _CapSpacing(spacing.points, spacing.radii, spacing.nominal, spacing.limited)
    caps = cap_points(region, field.vacancy.is_empty, on_caps, rng, progress)
    largest = float(spacing.radii.max())
    clearance = max(
        CLEARANCE_RADII * largest, CLEARANCE_CAP_RADII * float(caps.radii.max(initial=0.0))
    )
    side = lattice_side(region, largest, sampler.area / len(tiling))
    steiner = steiner_lattice(region, side, clearance, seed)
    return TilePlan(
        region, surface, sampler.area, spacing, tiling, steiner.points, steiner.ball_radius, caps,
        seed, (*dense.request.notes, *notes), nominal_edge(request, sampler.area, region),
        dense.target, dense.share, depth_samples,
    )  # fmt: skip
