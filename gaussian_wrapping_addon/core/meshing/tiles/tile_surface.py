# SPDX-License-Identifier: GPL-3.0-or-later
"""The surface of one tile: made manifold where it is the tile's alone, and prepared to be joined.

A point is the tile's alone if no other tile has a tetrahedron there: then the tile knows all faces
at it, and repair, removal of degenerate faces and vertex selection do there what they would do on
the whole surface. The selection is not applied yet. How many vertices a tile may keep depends on
all others; so each vertex gets the cost at which it is merged, and whoever joins the tiles chooses
one highest cost for all. The other points stay as they are, in a band along the tile's border.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...mesh.components import compacted
from ...mesh.simplification.vertex_selection import Units, merge_vertices
from ...regions.convex_region import Region
from ..cleanup.degenerate import remove_degenerate
from ..cleanup.repair import split_nonmanifold
from ..primal_adaptive import DEGENERATE_SHARE, KIND_SPLIT, LONGEST_EDGE_SHARE
from .plan import TilePlan
from .tile_faces import TileFaces
from .tile_points import GatheredPoints

DEEPER = 4
"""Mergers go on until this many times fewer vertices are left than stay on average: in tiles that
are flatter than others fewer stay."""


@dataclass(frozen=True)
class TileSurface:
    """Dense faces of a tile, and the order in which its vertices may be merged."""

    vertices: np.ndarray
    """(v, 3) float64, scene frame."""
    faces: np.ndarray
    """(f, 3) int32, oriented outward; open along the tile's border."""
    number: np.ndarray
    """(v,) int32: index in the region's points of those that other tiles may have as well, else
    -1."""
    kind: np.ndarray
    """(v,) uint8."""
    into: np.ndarray
    """(v,) int32, and ..."""
    level: np.ndarray
    """... (v,) float64: see :class:`~...mesh.simplification.vertex_selection.Merged`."""
    border: np.ndarray
    """(b, 3) int32: faces towards other tiles, as indices in the region's points."""
    solid: np.ndarray
    """(b,) bool: which of those have the tile's solid behind them; ``vertices`` has their
    corners."""
    least_height: float
    """Faces with a smaller height are removed; the same for all tiles."""
    figures: dict[str, Any]


def cost_units(region: Region) -> Units:
    """Return the units in which all tiles of a region measure costs."""
    return Units(np.asarray(region.center), region.diagonal)


def tile_surface(plan: TilePlan, gathered: GatheredPoints, part: TileFaces) -> TileSurface:
    """Repair a tile's faces where they are the tile's alone, and put its vertices in order."""
    cloud = gathered.cloud
    corners = np.concatenate([part.faces, part.border[part.solid]])
    shared = np.ones(len(cloud.points), np.bool_)
    shared[part.whole] = False
    shared[part.border] = True
    points, local, number = compacted(cloud.points, corners)
    fixed = shared[number]
    repaired = split_nonmanifold(points, local[: len(part.faces)], fixed)
    # Corners of border faces that the tile's own faces do not have.
    alone = np.setdiff1d(np.arange(len(points)), repaired.origin)
    vertices = np.concatenate([repaired.vertices, points[alone]])
    origin = np.concatenate([repaired.origin, alone])
    fixed = (origin >= 0) & fixed[np.maximum(origin, 0)]
    height = DEGENERATE_SHARE * float(cloud.radii.min())
    faces, _ = remove_degenerate(vertices, repaired.faces, height, plan.region, fixed)
    used = fixed.copy()
    used[faces] = True
    vertices, origin, fixed = vertices[used], origin[used], fixed[used]
    faces = (np.cumsum(used) - 1)[faces]
    kind = kinds_after(cloud.kind[number], repaired.origin)
    kind = np.append(kind, cloud.kind[number[alone]])[used]
    into, level = np.full(len(vertices), -1), np.full(len(vertices), np.inf)
    if plan.share < 1.0:
        least = int(fixed.sum()) + int(plan.share * (~fixed).sum()) // DEEPER
        merged = merge_vertices(
            vertices, faces, cost_units(plan.region), least, longest_edge(plan), locked=fixed
        )
        into, level = merged.into, merged.level
    figures = {
        **part.figures,
        "split_vertices": repaired.split_vertices,
        "split_edges": repaired.split_edges,
    }
    return TileSurface(
        vertices,
        faces.astype(np.int32),
        np.where(fixed, number[np.maximum(origin, 0)], -1).astype(np.int32),
        kind,
        into.astype(np.int32),
        level,
        part.border.astype(np.int32),
        part.solid,
        height,
        figures,
    )


def longest_edge(plan: TilePlan) -> float:
    """Return the greatest length of an edge of the simplified mesh."""
    return LONGEST_EDGE_SHARE * plan.region.diagonal


def kinds_after(before: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the kinds of repaired vertices, (w,) uint8.

    Parameters
    ----------
    before : (v,) uint8
        Of the vertices before.
    origin : (w,) int64
        See :class:`..cleanup.repair.RepairResult`.
    """
    copies = np.bincount(origin[origin >= 0], minlength=len(before))
    moved = (origin < 0) | (copies[np.maximum(origin, 0)] > 1)
    return np.where(moved, KIND_SPLIT, before[np.maximum(origin, 0)]).astype(np.uint8)
