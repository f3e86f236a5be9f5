# SPDX-License-Identifier: GPL-3.0-or-later
"""Sample the surface points of one tile, and gather the points of all tiles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...mesh.surface_sampling import EDGE_PER_RADIUS, thin
from ...progress import Progress
from ..points.resolution import ResolutionRequest
from ..points.surface_points import (
    KIND_CAP,
    KIND_JUMP,
    PRIORITY_SURFACE,
    SurfacePoints,
    SurfaceSampler,
)
from .plan import JITTER_SHARE, Field, TilePlan
from .steiner_points import CLEARANCE_CAP_RADII, CLEARANCE_RADII, outside_clearance

KIND_STEINER = 4
"""A Steiner point between inside and outside, where the field is ambiguous away from a surface."""

MARGIN_RADII = 4.0
"""Candidates up to this many of the largest radii beyond a tile may be projected into it."""

PIECE_RADII = 8.0
"""Triangles of the candidate surface across the border are split until edges are this short."""
MAX_SPLITS = 24


def tile_points(field: Field, plan: TilePlan, tile: int, progress: Progress) -> SurfacePoints:
    """Sample the points of a tile, thinned among themselves.

    The result is the same for any number of threads and on any machine of the same kind.
    """
    low, high = plan.tiling.box(tile)
    margin = MARGIN_RADII * plan.radius
    vertices, faces = pieces_in_box(
        plan.surface.vertices, plan.surface.faces, low - margin, high + margin,
        PIECE_RADII * plan.radius,
    )  # fmt: skip
    inside = plan.region.contains(vertices[faces].mean(1), margin)
    faces = faces[inside]
    if len(faces) == 0:
        return empty_points(plan)
    surface = replace(plan.surface, vertices=vertices, faces=faces)
    sampler = SurfaceSampler(field.vacancy, field.vectors, plan.region, surface, field.threads)
    if sampler.area <= 0.0:
        return empty_points(plan)
    rng = np.random.default_rng([plan.seed, tile, 0])
    return sampler.sample(
        ResolutionRequest(0.0, 0), rng, progress, spacing=plan.spacing,
        owned=lambda where: plan.tiling.owner(where) == tile,
    )  # fmt: skip


def empty_points(plan: TilePlan) -> SurfacePoints:
    """Return the points of a tile that holds no surface."""
    none = np.zeros((0, 3))
    return SurfacePoints(
        none, none, np.zeros(0, np.uint8), np.zeros(0), plan.spacing.nominal, (), {}
    )


def pieces_in_box(
    vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, high: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a triangle soup that covers the part of a surface in a box, and little more.

    Triangles across the border are bisected at their longest edge until it is shorter than
    ``length``; pieces outside are dropped.
    """
    corners = vertices[faces]  # (f, 3, 3)
    for _ in range(MAX_SPLITS):
        lowest, highest = corners.min(1), corners.max(1)
        corners = corners[((highest >= low) & (lowest <= high)).all(1)]
        edges = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2)  # (f, 3)
        whole = ((corners >= low[None, None]) & (corners <= high[None, None])).all((1, 2))
        cut = np.flatnonzero(~whole & (edges.max(1) > length))
        if len(cut) == 0:
            break
        longest = edges[cut].argmax(1)
        rows = np.arange(len(cut))
        a, b, c = (corners[cut][rows, (longest + k) % 3] for k in range(3))
        middle = (a + b) / 2
        first, second = np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)
        corners = np.concatenate([np.delete(corners, cut, 0), first, second])
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


@dataclass(frozen=True)
class GatheredPoints:
    """The points of the whole region: a few bytes each, held by every worker."""

    cloud: SurfacePoints
    """Surface points, cap points and Steiner points (normal 0, ``KIND_STEINER``)."""
    shifted: np.ndarray
    """(n, 3) float64: perturbed positions for the triangulation."""
    inner: np.ndarray
    """(n,) bool: false for Steiner points beyond the region."""


def gather(plan: TilePlan, parts: list[SurfacePoints]) -> GatheredPoints:
    """Thin the points of all tiles together with the caps; drop Steiner points near them.

    Parameters
    ----------
    parts : list of SurfacePoints
        In the order of the tiles.
    """
    rng = np.random.default_rng([plan.seed, len(plan.tiling), 1])
    caps = plan.caps
    points = np.concatenate([caps.points, *(part.points for part in parts)])
    normals = np.concatenate([caps.normals, *(part.normals for part in parts)])
    radii = np.concatenate([caps.radii, *(part.radii for part in parts)])
    kind = np.full(len(points), KIND_CAP, np.uint8)
    kind[len(caps.points) :] = np.concatenate([part.kind for part in parts])
    # As within a tile: jumps come last among surface points.
    priority = PRIORITY_SURFACE + 0.5 * (rng.random(len(points)) + (kind == KIND_JUMP))
    priority[: len(caps.points)] = caps.priority
    kept = thin(points, normals, radii, priority)
    points, normals, radii, kind = points[kept], normals[kept], radii[kept], kind[kept]
    is_cap = kind == KIND_CAP
    free = outside_clearance(plan.steiner_points, points[~is_cap], CLEARANCE_RADII * radii[~is_cap])
    free &= outside_clearance(
        plan.steiner_points, points[is_cap], CLEARANCE_CAP_RADII * radii[is_cap]
    )
    steiner_points = plan.steiner_points[free]
    figures = {
        "surface_points": int((~is_cap).sum()),
        "cap_points": int(is_cap.sum()),
        "fillers": len(steiner_points),
        "limited_by_photos_share": plan.spacing.limited,
        "shortest_spacing_scene": EDGE_PER_RADIUS * float(radii.min(initial=np.inf)),
        "longest_spacing_scene": EDGE_PER_RADIUS * float(radii.max(initial=0.0)),
    }
    for name in ("candidates", "dropped_candidates", "jump_points", "projection_evaluations"):
        figures[name] = sum(part.figures.get(name, 0) for part in parts)
    inner = np.concatenate(
        [np.ones(len(points), np.bool_), plan.region.distance(steiner_points) < 0]
    )
    cloud = SurfacePoints(
        np.concatenate([points, steiner_points]),
        np.concatenate([normals, np.zeros_like(steiner_points)]),
        np.concatenate([kind, np.full(len(steiner_points), KIND_STEINER, np.uint8)]),
        np.concatenate([radii, np.full(len(steiner_points), np.inf)]),
        plan.spacing.nominal,
        plan.notes,
        figures,
    )
    shift = JITTER_SHARE * plan.region.diagonal * rng.uniform(-1.0, 1.0, cloud.points.shape)
    return GatheredPoints(cloud, cloud.points + shift, inner)
