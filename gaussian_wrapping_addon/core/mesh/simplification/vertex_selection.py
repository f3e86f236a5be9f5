# SPDX-License-Identifier: GPL-3.0-or-later
"""Simplify a dense closed mesh to a subset of its vertices, by half-edge collapses.

Point density alone cannot adapt to a surface that curves in one direction only (a wire, a fold),
where long triangles along it suffice. Removing the cheapest vertex first finds both where and in
which directions edges may be long. No vertex moves, so all stay on the isosurface.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .engine import Simplification
from .half_edge_collapse import (
    HEAP_COLUMNS,
    MergeLog,
    ShapeBounds,
    collapse_half_edges,
    push_vertices,
)
from .quadrics import COLUMNS, add_face_quadrics

SHAPE_WEIGHT = 1e-6
"""Weight of squared length relative to squared height in the cost: it decides on flat surfaces."""

LEAST_ROUNDNESS = 0.03
"""Least height over longest edge of a changed triangle, unless it was narrower before."""

LEAST_COSINE = 0.3
"""Least cosine between the normals of a triangle before and after a change."""

_NO_LIMIT = np.iinfo(np.int64).max


def select_vertices(
    vertices: np.ndarray, faces: np.ndarray, target: int, longest: float
) -> np.ndarray:
    """Collapse edges onto one of their ends until ``target`` vertices are left.

    The cost of a vertex is its quadric error: the area-weighted sum of squared distances from the
    vertex that replaces it to the planes of all faces that it represents. A closed 2-manifold stays
    one, with the same genus and parts; no face turns over or becomes narrow.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
        A closed 2-manifold, every vertex used.
    target : int
        Number of vertices; more remain if no other can be removed.
    longest : float
        Greatest length of a new edge.

    Returns
    -------
    (g, 3) int64
        Faces over the same vertices, most of which are unused.
    """
    if len(vertices) <= target:
        return np.asarray(faces, np.int64)
    low, high = vertices.min(0), vertices.max(0)
    units = Units((low + high) / 2, float((high - low).max()))
    return merge_vertices(vertices, faces, units, target, longest).faces


class Units(NamedTuple):
    """What coordinates and costs are measured in; meshes whose costs are compared share it."""

    center: np.ndarray
    """(3,) float64."""
    length: float
    """About the size of the mesh."""

    def local(self, vertices: np.ndarray) -> np.ndarray:
        """Return vertices relative to the centre, in units of the length."""
        return np.ascontiguousarray((vertices - self.center) / self.length)


class Merged(NamedTuple):
    """Result of :func:`merge_vertices`."""

    faces: np.ndarray
    """(g, 3) int64 over the same vertices, most of which are unused."""
    into: np.ndarray
    """(v,) int64: the vertex that each has merged into, -1 for those that are left."""
    level: np.ndarray
    """(v,) float64: the highest cost up to the merger of each, infinite for those that are left.
    So those with a level of at most c have merged before all others."""
    quadrics: np.ndarray
    """(v, 11) float64: of those that are left, with those of all that merged into them."""


def merge_vertices(
    vertices: np.ndarray,
    faces: np.ndarray,
    units: Units,
    target: int,
    longest: float,
    *,
    most: float = np.inf,
    locked: np.ndarray | None = None,
    quadrics: np.ndarray | None = None,
) -> Merged:
    """Select vertices as :func:`select_vertices`, also on a part of a mesh.

    Parameters
    ----------
    faces : (f, 3) int
        Of a closed 2-manifold, at least all those at vertices that are not locked.
    most : float
        Highest cost of a merger.
    locked : (v,) bool, optional
        Vertices that stay, and that no other merges into.
    quadrics : (v, 11) float64, optional
        Instead of those of the faces, in the same units.
    """
    # Planes are weighted by twice the area of their face; corners have no weight.
    run = Simplification(
        units.local(vertices), np.array(faces, np.int64, order="C"), 1.0, 0.0,
        None if quadrics is None else quadrics.copy(),
    )  # fmt: skip
    count = len(vertices)
    bounds = tuple(
        ShapeBounds((longest / units.length) ** 2, SHAPE_WEIGHT, LEAST_ROUNDNESS, LEAST_COSINE)
    )
    log = MergeLog(
        np.zeros(count, np.bool_) if locked is None else locked,
        np.full(count, -1, np.int64), np.full(count, np.inf), np.zeros(1),
    )  # fmt: skip
    heap = run.empty_heap(2 * count, HEAP_COLUMNS)
    push_vertices(run.mesh, heap, run.counts, bounds, tuple(log))
    run.run(
        heap,
        lambda heap: collapse_half_edges(
            run.mesh, heap, run.counts, bounds, tuple(log), target, most, _NO_LIMIT
        ),
    )
    return Merged(run.faces(), log.into, log.level, run.mesh[4])


def quadrics_of(vertices: np.ndarray, faces: np.ndarray, units: Units) -> np.ndarray:
    """Return the quadric of each vertex, (v, 11) float64: the sum over its faces."""
    result = np.zeros((len(vertices), COLUMNS))
    faces = np.ascontiguousarray(faces, np.int64)
    add_face_quadrics(units.local(vertices), faces, result, 1.0, 0.0)
    return result


def left_of(into: np.ndarray, level: np.ndarray, most: float) -> np.ndarray:
    """Return for each vertex the one that stands for it after all mergers up to a level.

    Parameters
    ----------
    into, level : (v,)
        See :class:`Merged`.

    Returns
    -------
    (v,) int64
    """
    stands = np.arange(len(into))
    gone = level <= most
    stands[gone] = into[gone]
    while not np.array_equal(further := stands[stands], stands):
        stands = further
    return stands
