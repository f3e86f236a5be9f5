# SPDX-License-Identifier: GPL-3.0-or-later
"""A first, coarse surface of a region: two-pivot marching tetrahedra (method.md 6)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import MeshingError
from ..field.sightings import Sightings, bracket_pairs
from ..gaussians.model import GaussianArrays
from ..progress import Progress
from .convex_region import Region
from .delaunay import delaunay, far_points
from .marching_tetrahedra import IsEmpty, bisect, marching_tetrahedra
from .pivots import MAX_PIVOT_GAUSSIANS, reaching, representative, two_pivots

PROBES = 4096
"""Points spread through the region besides the pivots: a Gaussian that is as large as the region
may have both pivots outside it."""

MARGIN_SHARE = 0.02
"""Gaussians this share of the diagonal beyond the region take part, so that the surface near the
boundary is not the hull of too few pivots."""

BRACKET_SHARE = 0.003
"""Edges are bisected to this share of the region's diagonal; later steps find the surface."""


@dataclass(frozen=True)
class CandidateSurface:
    """A triangle soup near the isosurface, inside the region and slightly beyond."""

    vertices: np.ndarray
    """(v, 3) float64."""
    faces: np.ndarray
    """(f, 3) int64, towards the empty side."""
    gaussians: int
    """Gaussians that reach the region."""
    pivots: int
    """Pivots that were connected."""


def candidate_surface(
    arrays: GaussianArrays,
    region: Region,
    is_empty: IsEmpty,
    tolerance: float,
    seed: int,
    progress: Progress,
    sightings: Sightings | None = None,
    *,
    pivots_of: Callable[[GaussianArrays, np.ndarray], np.ndarray] = two_pivots,
) -> CandidateSurface:
    """Extract the isosurface on the Delaunay edges of two pivots per Gaussian and sighting.

    Parameters
    ----------
    tolerance : float
        Length of the bracket on crossing edges; 0 takes :data:`BRACKET_SHARE`.
    sightings : Sightings, optional
        Of the cameras in the region: parts about as thin as a pixel are found by these alone.
    pivots_of : callable
        Gives the pivots of chosen Gaussians instead of :func:`~.pivots.two_pivots`.

    Raises
    ------
    MeshingError
        No Gaussian reaches the region, or nothing in it is occupied.
    """
    margin = MARGIN_SHARE * region.diagonal
    index = reaching(arrays, region, margin)
    hint = "Draw the region around something that was photographed."
    if len(index) == 0:
        raise MeshingError(f"No Gaussian reaches region {region.name!r}.", hint)
    chosen = representative(arrays, index, MAX_PIVOT_GAUSSIANS)
    pivots = pivots_of(arrays, chosen)
    pivots = pivots[region.distance(pivots) <= 0.5 * region.diagonal]
    pivots = np.concatenate([pivots, _probes(region, margin, seed)])
    if sightings is not None:
        pivots = np.concatenate([pivots, *bracket_pairs(sightings, is_empty)])
    points = np.concatenate([pivots, far_points(pivots, seed)])
    tetrahedra = delaunay(points, seed=seed, progress=progress.span(0.0, 0.3))
    progress.update(0.3, f"evaluating {len(pivots)} pivots")
    inside = np.zeros(len(points), np.bool_)  # far points are empty by definition
    inside[: len(pivots)] = ~is_empty(pivots)
    edges, faces = marching_tetrahedra(_near(points, tetrahedra, region, margin), inside)
    if len(faces) == 0:
        raise MeshingError(f"Region {region.name!r} holds no surface.", hint)
    tolerance = tolerance or BRACKET_SHARE * region.diagonal
    ends = bisect(points[edges[:, 0]], points[edges[:, 1]], is_empty, tolerance,
                  progress.span(0.6, 1.0))  # fmt: skip
    vertices = (ends[0] + ends[1]) / 2
    kept = region.distance(vertices[faces].mean(1)) <= margin
    if not kept.any():
        raise MeshingError(f"Region {region.name!r} holds no surface.", hint)
    return CandidateSurface(vertices, faces[kept], len(index), len(pivots))


def _probes(region: Region, margin: float, seed: int) -> np.ndarray:
    """Return about :data:`PROBES` jittered lattice points in and just around the region."""
    low, high = region.bounds[0] - margin, region.bounds[1] + margin
    side = float(np.prod(high - low) / PROBES) ** (1 / 3)
    counts = np.maximum(1, np.ceil((high - low) / side)).astype(int)
    lattice = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), -1)
    lattice = lattice.reshape(-1, 3)  # (k, 3)
    jitter = np.random.default_rng(seed).random(lattice.shape)
    points = low + (lattice + jitter) / counts * (high - low)
    return points[region.distance(points) <= margin]


def _near(points: np.ndarray, tetrahedra: np.ndarray, region: Region, margin: float) -> np.ndarray:
    """Leave out tetrahedra that lie wholly beyond one face of the region."""
    normals, offsets = region.half_spaces
    kept = np.ones(len(tetrahedra), np.bool_)
    for normal, offset in zip(normals, offsets, strict=True):
        beyond = (points - region.center) @ normal - offset > margin
        kept &= ~beyond[tetrahedra].all(1)
    return tetrahedra[kept]
