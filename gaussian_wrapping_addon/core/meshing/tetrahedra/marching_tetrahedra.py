# SPDX-License-Identifier: GPL-3.0-or-later
"""Marching tetrahedra on labelled points, and bisection of crossing edges.

See docs/method.md, section 6.3.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from ...progress import Progress
from .boundary_faces import OUTWARD_FACES

IsEmpty = Callable[[np.ndarray], np.ndarray]
"""Maps (n, 3) points to (n,) bool: on the empty side."""

MAX_BISECTIONS = 40


@functools.lru_cache(maxsize=1)
def case_tables() -> tuple[np.ndarray, np.ndarray]:
    """Return the triangle table of all 16 cases.

    Bit k of a case is set where corner k is inside. The table is derived from a reference
    tetrahedron, so that triangles of positively oriented tetrahedra face the empty side.

    Returns
    -------
    counts : (16,) int64
        Triangles of each case: 0, 1 or 2.
    corners : (16, 2, 3, 2) int64
        For each triangle vertex the (inside, outside) corners of its edge.
    """
    reference = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
    counts = np.zeros(16, np.int64)
    corners = np.zeros((16, 2, 3, 2), np.int64)
    for code in range(1, 15):
        inside = [k for k in range(4) if code >> k & 1]
        outside = [k for k in range(4) if not code >> k & 1]
        if len(inside) == 2:
            (i, j), (k, m) = inside, outside
            polygon = [(i, k), (i, m), (j, m), (j, k)]
        else:
            polygon = [(i, k) for i in inside for k in outside]
        middle = np.array([(reference[i] + reference[k]) / 2 for i, k in polygon])
        normal = np.cross(middle[1] - middle[0], middle[2] - middle[0])
        if normal @ (reference[outside].mean(0) - reference[inside].mean(0)) < 0:
            polygon.reverse()
        counts[code] = len(polygon) - 2
        for t in range(counts[code]):
            corners[code, t] = [polygon[0], polygon[t + 1], polygon[t + 2]]
    return counts, corners


def marching_tetrahedra(
    tetrahedra: np.ndarray, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the surface between inside and outside points, with vertices on edges.

    Parameters
    ----------
    tetrahedra : (m, 4) int64
        Positively oriented, face to face.
    inside : (n,) bool
        Label of each point. The surface is closed if no point of the hull is inside.

    Returns
    -------
    edges : (e, 2) int64
        Crossing edges (inside point, outside point); vertex i of the mesh lies on edge i.
    faces : (f, 3) int64
        Triangles, counter-clockwise seen from the empty side.
    """
    return _indexed(_separating(tetrahedra, inside), len(inside))


def marching_closed(
    tetrahedra: np.ndarray, neighbours: np.ndarray, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the boundary of the inside part of tetrahedra, including caps on their hull.

    The surface is a closed 2-manifold if the tetrahedra are a 3-manifold with boundary: no sign is
    zero, so the isosurface crosses every tetrahedron and every face of the hull transversally.

    Parameters
    ----------
    tetrahedra : (m, 4) int64
        Positively oriented, face to face.
    neighbours : (m, 4) int64
        :func:`.boundary_faces.tetrahedron_neighbours`.
    inside : (n,) bool

    Returns
    -------
    edges : (e, 2) int64
        For each vertex of the mesh its crossing edge (inside point, outside point), or an inside
        point of the hull twice.
    faces : (f, 3) int64
        Triangles, counter-clockwise seen from outside.
    """
    pieces = _separating(tetrahedra, inside)
    tetrahedron, corner = np.nonzero(neighbours < 0)
    hull = tetrahedra[tetrahedron[:, None], OUTWARD_FACES[corner]]  # (h, 3)
    codes = inside[hull] @ np.array([1, 2, 4])
    for code, triangles in enumerate(_CAP_TRIANGLES):
        rows = np.flatnonzero(codes == code)
        pieces.extend(hull[rows[:, None, None], np.array(t)] for t in triangles)
    return _indexed(pieces, len(inside))


def _separating(tetrahedra: np.ndarray, inside: np.ndarray) -> list[np.ndarray]:
    """Return triangles between inside and outside points as arrays of edges, (r, 3, 2)."""
    counts, corners = case_tables()
    codes = inside[tetrahedra] @ np.array([1, 2, 4, 8])  # (m,)
    pieces = []
    for t in range(2):
        rows = np.flatnonzero(counts[codes] > t)
        pieces.append(tetrahedra[rows[:, None, None], corners[codes[rows], t]])
    return pieces


def _cap_triangles(code: int) -> list[list[tuple[int, int]]]:
    """Return the triangles of the inside part of a triangle; bit k of the code: corner k inside."""
    ring: list[tuple[int, int]] = []
    for k in range(3):
        following = (k + 1) % 3
        here, there = code >> k & 1, code >> following & 1
        if here:
            ring.append((k, k))
        if here != there:
            ring.append((k, following) if here else (following, k))
    return [[ring[0], ring[t], ring[t + 1]] for t in range(1, len(ring) - 1)]


_CAP_TRIANGLES = [_cap_triangles(code) for code in range(8)]


def _indexed(pieces: list[np.ndarray], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Merge equal edges of triangles (r, 3, 2) to vertices; return edges and indexed faces."""
    edges = np.concatenate(pieces).reshape(-1, 2)  # (3f, 2)
    keys = edges[:, 0] * np.int64(count) + edges[:, 1]
    unique, index = np.unique(keys, return_inverse=True)
    return np.stack([unique // count, unique % count], 1), index.reshape(-1, 3)


def bisect(
    inside_points: np.ndarray,
    outside_points: np.ndarray,
    is_empty: IsEmpty,
    tolerance: float | np.ndarray,
    progress: Progress,
) -> tuple[np.ndarray, np.ndarray]:
    """Bisect segments until the sign change is bracketed within ``tolerance``.

    Segments that are short enough stop early, which saves evaluations.

    Parameters
    ----------
    inside_points, outside_points : (n, 3) float64
        Occupied and empty ends.
    tolerance : float or (n,) float64
        Largest final length of a bracket, one for all or one each.

    Returns
    -------
    inside, outside : (n, 3) float64
        Ends of the brackets.
    """
    inside, outside = inside_points.copy(), outside_points.copy()
    for step in range(MAX_BISECTIONS):
        rows = np.flatnonzero(np.linalg.norm(outside - inside, axis=1) > tolerance)
        if len(rows) == 0:
            break
        progress.update(step / MAX_BISECTIONS, f"bisecting {len(rows)} edges")
        middle = (inside[rows] + outside[rows]) / 2
        empty = is_empty(middle)
        outside[rows[empty]] = middle[empty]
        inside[rows[~empty]] = middle[~empty]
    return inside, outside
