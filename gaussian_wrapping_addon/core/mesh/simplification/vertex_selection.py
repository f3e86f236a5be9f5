# SPDX-License-Identifier: GPL-3.0-or-later
"""Which vertices of a dense closed mesh a coarser one keeps: those that its shape needs.

Density alone cannot follow a surface that curves one way only (a wire, a fold): long triangles
along it would do. Removing vertices one by one, the cheapest first, finds both the places and the
directions in which edges may be long. No vertex moves, so all stay on the isosurface.
"""

from __future__ import annotations

import numpy as np

from .engine import Simplification
from .half_edge_collapse import HEAP_COLUMNS, ShapeBounds, collapse_half_edges, push_vertices

SHAPE_WEIGHT = 1e-6
"""Price of length beside that of height, both squared: it decides where the surface is flat."""

LEAST_ROUNDNESS = 0.03
"""Height over the longest edge that a changed triangle must keep, unless it was narrower."""

LEAST_COSINE = 0.3
"""Between normals of a triangle before and after a change."""

_NO_LIMIT = np.iinfo(np.int64).max


def select_vertices(
    vertices: np.ndarray, faces: np.ndarray, target: int, longest: float
) -> np.ndarray:
    """Collapse edges onto one of their ends until ``target`` vertices are left.

    The price of a vertex is the sum of squared distances from the vertex that replaces it to the
    planes of all faces that it has stood for, by area (quadric error). A closed 2-manifold stays
    one, with the same genus and parts; no face turns over or becomes narrow.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
        A closed 2-manifold, every vertex used.
    target : int
        Number of vertices; more stay where no vertex can go.
    longest : float
        No edge becomes longer.

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
    # Planes weigh twice the area of their face; corners nothing.
    run = Simplification(local, np.array(faces, np.int64, order="C"), 1.0, 0.0)
    heap = run.empty_heap(2 * len(vertices), HEAP_COLUMNS)
    push_vertices(run.mesh, heap, run.counts, bounds)
    run.run(
        heap,
        lambda heap: collapse_half_edges(run.mesh, heap, run.counts, bounds, target, _NO_LIMIT),
    )
    return run.faces()
