# SPDX-License-Identifier: GPL-3.0-or-later
"""Candidate surface: a first, coarse isosurface by two-pivot marching tetrahedra.

See docs/method.md, section 6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...errors import MeshingError
from ...field.depth_samples import DepthSamples, bracket_pairs
from ...gaussians.model import GaussianArrays
from ...progress import Progress
from ...regions.convex_region import Region
from ..tetrahedra.delaunay import bounding_points, delaunay
from ..tetrahedra.marching_tetrahedra import IsEmpty, bisect, marching_tetrahedra
from .pivots import (
    MAX_PIVOT_GAUSSIANS,
    PivotRule,
    gaussians_reaching,
    representative_gaussians,
    two_pivots,
)

PROBES = 4096
"""Sample points through the region besides the pivots: a Gaussian as large as the region may have
both pivots outside it."""

MARGIN_SHARE = 0.02
"""Gaussians up to this share of the diagonal beyond the region are included, so that the surface
near the boundary is not the hull of too few pivots."""

HALO_SHARE = 0.5
"""Pivots farther from the region than this share of its diagonal are left out: the bounding points
close the triangulation, and the field need not be known there."""

NO_SURFACE_HINT = "Draw the region around something that was photographed."

BRACKET_SHARE = 0.003
"""Edges are bisected to this share of the region's diagonal; later steps refine the position."""


@dataclass(frozen=True)
class CandidateSurface:
    """A triangle soup near the isosurface, in the region and slightly beyond it."""

    vertices: np.ndarray
    """(v, 3) float64."""
    faces: np.ndarray
    """(f, 3) int64, facing the empty side."""
    gaussians: int
    """Gaussians that reach the region."""
    pivots: int
    """Points that were triangulated."""


def candidate_surface(
    arrays: GaussianArrays,
    region: Region,
    is_empty: IsEmpty,
    tolerance: float,
    seed: int,
    progress: Progress,
    depth_samples: DepthSamples | None = None,
) -> CandidateSurface:
    """Extract the isosurface on the Delaunay edges of two pivots per Gaussian and depth sample.

    Parameters
    ----------
    tolerance : float
        Length of the bracket on crossing edges; 0 stands for :data:`BRACKET_SHARE`.
    depth_samples : DepthSamples, optional
        Of the region: parts about as thin as a pixel are found only by these.

    Raises
    ------
    MeshingError
        No Gaussian reaches the region, or nothing in it is occupied by the solid.
    """
    margin = MARGIN_SHARE * region.diagonal
    is_empty = _within_halo(is_empty, region)
    cloud = pivot_cloud(arrays, region, is_empty, seed, depth_samples)
    pivots = cloud.points
    points = np.concatenate([pivots, bounding_points(pivots, seed)])
    tetrahedra = delaunay(points, seed=seed, progress=progress.span(0.0, 0.3))
    progress.update(0.3, f"evaluating {len(pivots)} pivots")
    inside = np.zeros(len(points), np.bool_)  # bounding points are empty by definition
    inside[: len(pivots)] = ~is_empty(pivots)
    edges, faces = marching_tetrahedra(_near(points, tetrahedra, region, margin), inside)
    if len(faces) == 0:
        raise no_surface_error(region)
    tolerance = tolerance or BRACKET_SHARE * region.diagonal
    ends = bisect(points[edges[:, 0]], points[edges[:, 1]], is_empty, tolerance,
                  progress.span(0.6, 1.0))  # fmt: skip
    vertices = (ends[0] + ends[1]) / 2
    kept = region.distance(vertices[faces].mean(1)) <= margin
    if not kept.any():
        raise no_surface_error(region)
    return CandidateSurface(vertices, faces[kept], cloud.gaussians, len(pivots))


@dataclass(frozen=True)
class PivotCloud:
    """Points whose Delaunay edges are searched for the isosurface of a region."""

    points: np.ndarray
    """(p, 3) float64, all within :func:`halo_bounds`."""
    gaussians: int
    """Gaussians that reach the region."""
    chosen: int
    """Those of them that contributed pivots."""


def pivot_cloud(
    arrays: GaussianArrays,
    region: Region,
    is_empty: IsEmpty,
    seed: int,
    depth_samples: DepthSamples | None,
    *,
    pivots_of: PivotRule = two_pivots,
) -> PivotCloud:
    """Collect pivots, probes and pairs that bracket the visible surface, in and around a region.

    Raises
    ------
    MeshingError
        No Gaussian reaches the region.
    """
    own = pivots_and_probes(arrays, region, seed, pivots_of)
    if depth_samples is None:
        return own
    points = np.concatenate(bracket_pairs(depth_samples, is_empty))
    return replace(own, points=np.concatenate([own.points, _in_halo(points, region)]))


def pivots_and_probes(
    arrays: GaussianArrays,
    region: Region,
    seed: int,
    pivots_of: PivotRule,
) -> PivotCloud:
    """Collect pivots and probes alone, in and around a region, without evaluating the field.

    Raises
    ------
    MeshingError
        No Gaussian reaches the region.
    """
    margin = MARGIN_SHARE * region.diagonal
    index = gaussians_reaching(arrays, region, margin)
    if len(index) == 0:
        raise no_gaussian_error(region)
    chosen = representative_gaussians(arrays, index, MAX_PIVOT_GAUSSIANS)
    pivots = pivots_of(arrays, chosen)
    near = pivots[region.distance(pivots) <= HALO_SHARE * region.diagonal]
    points = np.concatenate([near, _probes(region, margin, seed)])
    return PivotCloud(_in_halo(points, region), len(index), len(chosen))


def pivots_alone(arrays: GaussianArrays, region: Region, pivots_of: PivotRule) -> PivotCloud:
    """Collect the pivots of all Gaussians that reach a region, faint ones too, and nothing else.

    These are the points of the paper (docs/method.md, section 6.1): without samples of depth maps,
    probes, or a limit on the number of Gaussians. Pivots in the region's halo are kept.

    Raises
    ------
    MeshingError
        No Gaussian reaches the region.
    """
    index = gaussians_reaching(arrays, region, MARGIN_SHARE * region.diagonal, faint=True)
    if len(index) == 0:
        raise no_gaussian_error(region)
    return PivotCloud(_in_halo(pivots_of(arrays, index), region), len(index), len(index))


def _in_halo(points: np.ndarray, region: Region) -> np.ndarray:
    low, high = halo_bounds(region)
    return points[((points >= low) & (points <= high)).all(1)]


def halo_bounds(region: Region) -> np.ndarray:
    """Return the box, (2, 3) float64, of all points whose label matters for a region."""
    low, high = region.bounds
    halo = HALO_SHARE * region.diagonal
    return np.stack([low - halo, high + halo])


def _within_halo(is_empty: IsEmpty, region: Region) -> IsEmpty:
    """Restrict ``is_empty`` to the halo; all other points are empty, as the bounding points are."""
    low, high = halo_bounds(region)

    def inside_only(points: np.ndarray) -> np.ndarray:
        near = ((points >= low) & (points <= high)).all(1)
        empty = np.ones(len(points), np.bool_)
        empty[near] = is_empty(points[near])
        return empty

    return inside_only


def no_gaussian_error(region: Region) -> MeshingError:
    """Return the error of a region that no Gaussian reaches."""
    return MeshingError(f"No Gaussian reaches region {region.name!r}.", NO_SURFACE_HINT)


def no_surface_error(region: Region) -> MeshingError:
    """Return the error of a region without a surface."""
    return MeshingError(f"Region {region.name!r} holds no surface.", NO_SURFACE_HINT)


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
    """Drop the tetrahedra that lie wholly beyond one face of the region."""
    normals, offsets = region.half_spaces
    kept = np.ones(len(tetrahedra), np.bool_)
    for normal, offset in zip(normals, offsets, strict=True):
        beyond = (points - region.center) @ normal - offset > margin
        kept &= ~beyond[tetrahedra].all(1)
    return tetrahedra[kept]
