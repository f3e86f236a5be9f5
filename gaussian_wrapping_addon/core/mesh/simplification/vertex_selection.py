# SPDX-License-Identifier: GPL-3.0-or-later
"""Simplify a dense closed mesh to a subset of its vertices, by half-edge collapses.

Point density alone cannot adapt to a surface that curves in one direction only (a wire, a fold),
where long triangles along it suffice. Removing the cheapest vertex first finds both where and in
which directions edges may be long. No vertex moves, so all stay on the isosurface.
"""

from __future__ import annotations

import numpy as np

from .engine import Simplification
from .half_edge_collapse import HEAP_COLUMNS, ShapeBounds, collapse_half_edges, push_vertices

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
    unit = float((high - low).max())
    local = np.ascontiguousarray((vertices - (low + high) / 2) / unit)
    bounds = tuple(ShapeBounds((longest / unit) ** 2, SHAPE_WEIGHT, LEAST_ROUNDNESS, LEAST_COSINE))
    # Planes are weighted by twice the area of their face; corners have no weight.
    run = Simplification(local, np.array(faces, np.int64, order="C"), 1.0, 0.0)
    heap = run.empty_heap(2 * len(vertices), HEAP_COLUMNS)
    push_vertices(run.mesh, heap, run.counts, bounds)
    run.run(
        heap,
        lambda heap: collapse_half_edges(run.mesh, heap, run.counts, bounds, target, _NO_LIMIT),
    )
    return run.faces()
