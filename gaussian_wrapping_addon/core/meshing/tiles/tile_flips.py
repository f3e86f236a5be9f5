# SPDX-License-Identifier: GPL-3.0-or-later
"""Flip edges of the joined mesh, tile by tile, to follow the dense surface of each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...mesh.components import compacted
from ...mesh.simplification.edge_flips import flip_edges
from ...progress import Progress
from .plan import TilePlan
from .tile_surface import TileSurface, longest_edge

ROOM_RADII = 8.0
"""The dense surface is given this far, in the largest radii, around the edges that are flipped."""


def flip_by_tiles(
    plan: TilePlan,
    load: Callable[[int], TileSurface],
    boxes: np.ndarray,
    between: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    progress: Progress,
) -> np.ndarray:
    """Flip edges as :func:`~...mesh.simplification.edge_flips.flip_edges`, with little memory.

    Each tile's turn includes the faces just outside, so that edges across borders are flipped as
    well.

    Parameters
    ----------
    load : callable
        Returns the surface of a tile.
    boxes : (t, 2, 3) float64
        Bounds of each tile's surface.
    between : (b, 3, 3) float64
        Corners of the dense faces between tiles.
    vertices, faces : (v, 3) float64, (f, 3) int64
        The simplified mesh.

    Returns
    -------
    (f, 3) int64
    """
    faces = faces.copy()
    owner = plan.tiling.owner(vertices[faces].mean(1))
    for tile in range(len(plan.tiling)):
        progress.update(tile / len(plan.tiling), "turning edges")
        at = np.zeros(len(vertices), np.bool_)
        at[faces[owner == tile]] = True
        movable = at[faces].sum(1) >= 2
        if not movable.any():
            continue
        at[faces[movable]] = True
        low = vertices[at].min(0) - ROOM_RADII * plan.radius
        high = vertices[at].max(0) + ROOM_RADII * plan.radius
        near = np.flatnonzero((boxes[:, 0] <= high).all(1) & (boxes[:, 1] >= low).all(1))
        soups = [_in_box(between, low, high)]
        for number in near.tolist():
            surface = load(number)
            soups.append(_in_box(surface.vertices[surface.faces], low, high))
        dense = np.concatenate(soups)
        del soups
        rows = np.flatnonzero(at[faces].any(1))
        points, local, source = compacted(vertices, faces[rows])
        turned = flip_edges(
            points, local, dense.reshape(-1, 3), np.arange(3 * len(dense)).reshape(-1, 3),
            longest_edge(plan), movable[rows],
        )  # fmt: skip
        faces[rows] = source[turned]
    return faces


def _in_box(corners: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the triangles (f, 3, 3) whose bounds overlap a box."""
    return corners[((corners.max(1) >= low) & (corners.min(1) <= high)).all(1)]
