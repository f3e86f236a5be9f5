# SPDX-License-Identifier: GPL-3.0-or-later
"""Cap points: samples of a region's boundary where it cuts the solid, to close the mesh there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...mesh.surface_sampling import sample_triangles, thin
from ...progress import Progress
from ...regions.convex_region import Region
from ..tetrahedra.marching_tetrahedra import IsEmpty, bisect
from .spacing import Spacing

MAX_CANDIDATES = 1_500_000
"""Most samples of the region's boundary; finer requests get coarser caps, which are flat anyway."""

OVERSAMPLING = 5.0
RIM_TOLERANCE_SHARE = 1e-3
"""Length of the bracket around the rim of a cap, in edge lengths."""

INNER_RADII = 2.0
"""Spacing inside a cap, in local radii: caps are flat."""

# Corners first, then edges, rims and the interior: the points that define the shape are kept.
PRIORITY_CORNER, PRIORITY_EDGE, PRIORITY_RIM, PRIORITY_INNER = 0.0, 1.0, 2.0, 4.0


@dataclass(frozen=True)
class Caps:
    """Occupied points on a region's boundary, thinned."""

    points: np.ndarray
    """(n, 3) float64."""
    normals: np.ndarray
    """(n, 3) float64: outward normal of the face; zero on edges and corners."""
    radii: np.ndarray
    """(n,) float64 for :func:`...mesh.surface_sampling.thin`."""
    priority: np.ndarray
    """(n,) float64 for the same."""


def no_caps() -> Caps:
    """Return empty caps, for a region whose boundary stays open."""
    return Caps(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))


def cap_points(
    region: Region,
    is_empty: IsEmpty,
    spacing: Spacing,
    rng: np.random.Generator,
    progress: Progress,
) -> Caps:
    """Sample the region's faces, sharp edges and corners where they lie in the solid.

    Segments between neighbouring occupied and empty samples of one face are bisected; the resulting
    points form the rim, where the isosurface meets the face.

    Parameters
    ----------
    spacing : Spacing
        Spacing of the surface; inside a cap it grows with the distance to the rim.
    """
    radius = max(spacing.nominal, np.sqrt(region.area * OVERSAMPLING / MAX_CANDIDATES))
    points, normals, face = _face_samples(region, radius, rng)
    progress.update(0.1, f"sampling the region's boundary ({len(points)} samples)")
    empty = is_empty(points)
    rim_in, rim_out, rim_face = _face_crossings(points, empty, face, radius)
    edge_points, edge_in, edge_out, corner_points = _edge_samples(region, is_empty, radius)
    progress.update(0.5, "sampling the region's boundary")
    inside, _ = bisect(
        np.concatenate([rim_in, edge_in]),
        np.concatenate([rim_out, edge_out]),
        is_empty,
        RIM_TOLERANCE_SHARE * radius,
        progress.span(0.5, 1.0),
    )
    face_normals = region.half_spaces[0]
    rim, edge_rim = inside[: len(rim_in)], inside[len(rim_in) :]
    inner = ~empty
    groups = (
        (corner_points, None, PRIORITY_CORNER),
        (edge_rim, None, PRIORITY_CORNER),
        (edge_points, None, PRIORITY_EDGE),
        (rim, face_normals[rim_face], PRIORITY_RIM),
        (points[inner], normals[inner], PRIORITY_INNER),
    )
    all_points = np.concatenate([g[0] for g in groups])
    all_normals = np.concatenate([np.zeros_like(g[0]) if g[1] is None else g[1] for g in groups])
    priority = np.concatenate([np.full(len(g[0]), g[2]) for g in groups])
    local = spacing.at(all_points)  # (n,)
    radii = np.where(priority == PRIORITY_INNER, INNER_RADII * local, local)
    kept = thin(all_points, all_normals, radii, priority)
    return Caps(all_points[kept], all_normals[kept], radii[kept], priority[kept])


def _face_samples(
    region: Region, radius: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return thinned samples of the whole boundary, their normals and planar faces."""
    count = int(min(MAX_CANDIDATES, OVERSAMPLING * region.area / radius**2)) + 16
    pieces = region.faces()
    corners = np.concatenate(pieces)  # (t, 3, 3)
    owner = np.repeat(np.arange(len(pieces)), [len(p) for p in pieces])
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    points, triangle = sample_triangles(corners.reshape(-1, 3), triangles, count, rng)
    face = owner[triangle]
    normals = region.half_spaces[0][face]
    kept = thin(points, normals, np.full(count, radius), rng.random(count))
    return points[kept], normals[kept], face[kept]


def _face_crossings(
    points: np.ndarray, empty: np.ndarray, face: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pair occupied with empty neighbours on one planar face."""
    none = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64)
    occupied, vacant = np.flatnonzero(~empty), np.flatnonzero(empty)
    if len(occupied) == 0 or len(vacant) == 0:
        return none
    pairs = cKDTree(points[occupied]).sparse_distance_matrix(
        cKDTree(points[vacant]), 1.6 * radius, output_type="coo_matrix"
    )
    order = np.lexsort((pairs.col, pairs.row))
    first, second = occupied[pairs.row[order]], vacant[pairs.col[order]]
    same = face[first] == face[second]
    return points[first[same]], points[second[same]], face[first[same]]


def _edge_samples(
    region: Region, is_empty: IsEmpty, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return occupied points on sharp edges, crossing segments on these, and occupied corners."""
    rows, owners = [], []
    for index, (begin, end) in enumerate(region.edges()):
        steps = max(1, round(float(np.linalg.norm(end - begin)) / radius / 1.2))
        share = np.linspace(0.0, 1.0, steps + 1)[:, None]  # (steps + 1, 1)
        rows.append(begin * (1 - share) + end * share)
        owners.append(np.full(steps + 1, index))
    points, owner = np.concatenate(rows), np.concatenate(owners)
    empty = is_empty(points)
    ends = np.append(True, owner[1:] != owner[:-1]) | np.append(owner[1:] != owner[:-1], True)
    change = np.flatnonzero((empty[1:] != empty[:-1]) & (owner[1:] == owner[:-1]))
    low_empty = empty[change]
    inside = np.where(low_empty, change + 1, change)
    outside = np.where(low_empty, change, change + 1)
    corners = np.unique(points[ends & ~empty], axis=0)
    return points[~empty & ~ends], points[inside], points[outside], corners
