# SPDX-License-Identifier: GPL-3.0-or-later
"""Plan of a tiled mesh: the candidate surface, spacing, borders and Steiner points of all tiles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ... import limits
from ...dataset.camera import Camera
from ...mesh.surface_sampling import POINTS_PER_SQUARE
from ...progress import Progress
from ...regions.convex_region import Region
from ...regions.tiling import Tiling, split_evenly
from ...report_warning import ReportWarning
from ..points.candidate_surface import CandidateSurface
from ..points.region_caps import Caps, cap_points
from ..points.resolution import DenseRequest, ResolutionRequest, dense_request, nominal_edge
from ..points.spacing import Spacing
from ..points.surface_points import SurfaceSampler
from .steiner_points import CLEARANCE_CAP_RADII, CLEARANCE_RADII, lattice_side, steiner_lattice

TILE_POINTS = 75_000
"""Most surface points of a tile if the number of tiles is automatic: its memory stays small
compared with the field's, and machines with several cores get enough tiles to distribute."""

WHOLE_POINTS = 400_000
"""Regions with at most this many surface points are meshed without tiles, memory permitting."""

JITTER_SHARE = 1e-6
"""Perturbation of all points, as a share of the region's diagonal, for the triangulation: that of
delaunay.JITTER_SHARE with its bounding points. Tiles must agree on it."""


@dataclass(frozen=True)
class Field:
    """The fields that define the surface; duck-typed as in :func:`.primal_adaptive.mesh_region`."""

    vacancy: Any
    vectors: Any
    threads: int


@dataclass(frozen=True)
class TilePlan:
    """Data shared by all tiles, fixed before any tile is meshed."""

    region: Region
    surface: CandidateSurface
    area: float
    """Area of the candidate surface in the region."""
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
    edge_length: float
    """Edge length of the uniform mesh that meets the request."""
    target: int
    share: float
    """Vertices to keep, as for :func:`.primal_adaptive.simplified`: 0 and 1 keep all."""
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
    field: Field,
    region: Region,
    surface: CandidateSurface,
    request: ResolutionRequest,
    progress: Progress,
    *,
    tiles: int,
    seed: int,
    cameras: Sequence[Camera],
    adaptive: bool,
    depth_samples: int,
) -> TilePlan:
    """Compute the data that tiles share.

    Parameters
    ----------
    tiles : int
        Number of tiles; 0 chooses it by :data:`TILE_POINTS`.

    Raises
    ------
    ResourceError
        The request needs more points than the limit.
    """
    rng = np.random.default_rng(seed)
    sampler = SurfaceSampler(
        field.vacancy, field.vectors, region, surface, field.threads,
        cameras=cameras if adaptive else (),
    )  # fmt: skip
    dense = (
        dense_request(request, sampler.area, region) if adaptive else DenseRequest(request, 0, 1.0)
    )
    spacing, notes = sampler.spacing(dense.request, rng)
    corners = surface.vertices[surface.faces]  # (f, 3, 3)
    centers = corners.mean(1)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    expected = POINTS_PER_SQUARE * spacing.at(centers, field.threads) ** -2.0
    expected *= 0.5 * np.linalg.norm(cross, axis=1) * region.contains(centers)  # (f,) points

    def enough(count: int, heaviest: float) -> bool:
        if tiles > 0:
            return count >= tiles
        return heaviest <= TILE_POINTS or count >= limits.MAX_TILES

    tiling = split_evenly(centers, expected, region.bounds, enough)
    caps = cap_points(
        region, field.vacancy.is_empty,
        _CapSpacing(spacing.points, spacing.radii, spacing.nominal, spacing.limited), rng,
        progress,
    )  # fmt: skip
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
