# SPDX-License-Identifier: GPL-3.0-or-later
"""Label the tetrahedra of one tile and extract its part of the boundary faces.

Each tetrahedron inside the region is owned by the tile of its corner with the smallest index. All
tiles agree on the tetrahedron (:mod:`.steiner_points`), and only its owner labels it. So the faces
of all tiles together bound a set of tetrahedra of one triangulation: they are closed, whatever the
labels are.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...progress import Progress
from ..tetrahedra.boundary_faces import OUTWARD_FACES, tetrahedron_neighbours
from ..tetrahedra.classification import classify, on_one_sheet
from ..tetrahedra.delaunay import bounding_points, delaunay
from .plan import Field, TilePlan
from .tile_points import GatheredPoints

CONTEXT_RADII = 4.0
"""Tetrahedra of other tiles within this distance are labelled as well, as neighbours of the own."""


@dataclass(frozen=True)
class TileFaces:
    """Faces of one tile; corners are indices into the gathered points of the region."""

    faces: np.ndarray
    """(f, 3) int64, oriented outward: between two tetrahedra of the tile, or on the region's
    boundary."""
    border: np.ndarray
    """(b, 3) int64: faces between the tile's tetrahedra and others, oriented out of the tile's."""
    solid: np.ndarray
    """(b,) bool: whether the tile's tetrahedron at that face is inside."""
    figures: dict[str, Any]
    whole: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(p,) int64, increasing: points whose faces are all in ``faces``, since no other tile has a
    tetrahedron there."""


def tile_faces(
    field: Field, plan: TilePlan, gathered: GatheredPoints, tile: int, progress: Progress
) -> TileFaces:
    """Triangulate the points in and around a tile, label its tetrahedra, return its faces."""
    numbers = np.flatnonzero(plan.tiling.within(tile, gathered.shifted, plan.halo))
    own = plan.tiling.owner(gathered.cloud.points[numbers]) == tile
    if not (own & gathered.inner[numbers]).any():
        return _no_faces()
    seed = int(np.random.default_rng([plan.seed, tile, 2]).integers(2**31))
    numbers, tetrahedra = local_tetrahedra(plan, gathered, tile, seed, progress.span(0.0, 0.2))
    # Farther away they may differ from the triangulation of the whole region.
    near = np.zeros(len(numbers) + 8, np.bool_)
    near[: len(numbers)] = plan.tiling.within(
        tile, gathered.cloud.points[numbers], CONTEXT_RADII * plan.radius
    )
    tetrahedra = tetrahedra[near[tetrahedra].any(1)]
    neighbours = tetrahedron_neighbours(tetrahedra)
    inner = np.append(gathered.inner[numbers], np.zeros(8, np.bool_))
    outer = ~inner[tetrahedra].all(1)
    # Indices of the region's points increase with the local ones.
    first = tetrahedra.min(1)
    owned = ~outer & np.append(own, np.zeros(8, np.bool_))[first]
    # Only outer tetrahedra have bounding points as corners, whose positions are not used.
    points = np.concatenate([gathered.cloud.points[numbers], np.zeros((8, 3))])
    labels = classify(
        points,
        tetrahedra,
        neighbours,
        outer,
        on_one_sheet(
            points,
            tetrahedra,
            gathered.cloud.normals[numbers],
            outer,
            gathered.cloud.radii[numbers],
        ),
        lambda where: field.vacancy.vacancy(where).filled,
        np.random.default_rng([plan.seed, tile, 3]),
        progress.span(0.2, 1.0),
    )
    inside = labels.inside
    known = np.where(neighbours >= 0, owned[neighbours], False)  # (m, 4)
    theirs = np.where(neighbours >= 0, inside[neighbours], False)
    # A neighbour with a corner in the tile is the same in all tiles.
    own = np.append(own, np.zeros(8, np.bool_))
    beyond = np.nonzero(owned[:, None] & (neighbours >= 0) & outer[neighbours])
    known[beyond] = own[tetrahedra[beyond[0][:, None], OUTWARD_FACES[beyond[1]]]].any(1)
    theirs[beyond] = False
    tetrahedron, corner = np.nonzero((owned & inside)[:, None] & known & ~theirs)
    faces = numbers[tetrahedra[tetrahedron[:, None], OUTWARD_FACES[corner]]]
    tetrahedron, corner = np.nonzero(owned[:, None] & ~known)
    border = numbers[tetrahedra[tetrahedron[:, None], OUTWARD_FACES[corner]]]
    # All tetrahedra at points of the tile are there.
    whole = own.copy()
    whole[tetrahedra[~owned & ~outer]] = False
    figures = {
        "tetrahedra": int(owned.sum()),
        "interior_samples": int(labels.samples[owned].sum()),
        "relabelled_tetrahedra": labels.flipped,
        "undecided_tetrahedra": labels.undecided,
    }
    whole = numbers[whole[:-8] & gathered.inner[numbers]]
    return TileFaces(faces, border, inside[tetrahedron], figures, whole)


def local_tetrahedra(
    plan: TilePlan, gathered: GatheredPoints, tile: int, seed: int, progress: Progress
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the points in and around a tile.

    Tetrahedra with a corner in the tile and one in the region are those of the whole region.

    Returns
    -------
    numbers : (n,) int64
        Indices of the points, increasing.
    tetrahedra : (m, 4) int64
        Indices into ``numbers``; n and above are bounding points.
    """
    numbers = np.flatnonzero(plan.tiling.within(tile, gathered.shifted, plan.halo))
    shifted = gathered.shifted[numbers]
    shifted = np.concatenate([shifted, bounding_points(shifted, seed)])
    tetrahedra = delaunay(shifted, seed=seed, progress=progress, jitter_share=0.0)
    return numbers, tetrahedra


def _no_faces() -> TileFaces:
    none = np.zeros((0, 3), np.int64)
    return TileFaces(none, none, np.zeros(0, np.bool_), {})
