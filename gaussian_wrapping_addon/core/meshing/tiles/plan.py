# SPDX-License-Identifier: GPL-3.0-or-later
"""What all tiles of a region share: candidate surface, spacing, borders, fillers, caps."""

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
from ...report_warning import ReportWarning
from ..points.candidate_surface import CandidateSurface
from ..points.region_caps import Caps, cap_points
from ..points.resolution import DenseRequest, ResolutionRequest, dense_request, nominal_edge
from ..points.spacing import Spacing
from ..points.surface_points import SurfaceSampler
from .steiner_points import CLEARANCE_CAP_RADII, CLEARANCE_RADII, lattice_side, steiner_lattice
from .tiling import Tiling, split_evenly

TILE_POINTS = 75_000
"""Surface points of a tile, at most, where the number of tiles is automatic: memory stays small
beside that of the field, and a machine with several cores gets enough tiles to share out."""

WHOLE_POINTS = 400_000
"""Regions with no more surface points are meshed whole, where memory allows it."""

JITTER_SHARE = 1e-6
"""Shift of all points, as a share of the region's diagonal, while connectivity is decided: that of
delaunay.JITTER_SHARE with its far points. Tiles must agree on it."""


@dataclass(frozen=True)
class Field:
    """Where surface points come from; duck-typed as in :func:`.primal_adaptive.mesh_region`."""

    vacancy: Any
    vectors: Any
    threads: int


@dataclass(frozen=True)
class TilePlan:
    """Decided once, before any tile is worked on."""

    region: Region
    surface: CandidateSurface
    area: float
    """Of the candidate surface in the region."""
    spacing: Spacing
    """Local thinning radii of the whole surface, of the denser mesh with adaptive spacing."""
    tiling: Tiling
    steiner_points: np.ndarray
    """(k, 3) float64, before any gives way."""
    ball_radius: float
    """Largest empty ball that touches the region."""
    caps: Caps
    seed: int
    notes: tuple[ReportWarning, ...]
    edge_length: float
    """Of the uniform mesh that the request stands for."""
    target: int
    share: float
    """Vertices that stay, as for :func:`.primal_adaptive.simplified`: 0 and 1 keep all."""
    depth_samples: int = 0

    @property
    def radius(self) -> float:
        """Largest thinning radius."""
        return float(self.spacing.radii.max())

    @property
    def halo(self) -> float:
        """Width of the surroundings from which a tile's tetrahedra are known exactly.

        A tetrahedron with a corner in the tile lies in a ball of radius ``ball_radius`` through
        that corner; twice that much again for balls that might hold a point.
        """
        return 2.0 * self.ball_radius + 2.0 * JITTER_SHARE * self.region.diagonal


class _CapSpacing(Spacing):
    """Spacing that does not grow inside a cap: its points bound the empty balls there."""

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
    """Decide everything that tiles share.

    Parameters
    ----------
    tiles : int
        Number of tiles; 0 makes as many as :data:`TILE_POINTS` asks for.

    Raises
    ------
    ResourceError
        The request needs more points than the cap.
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
