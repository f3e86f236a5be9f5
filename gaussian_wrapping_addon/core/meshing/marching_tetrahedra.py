# SPDX-License-Identifier: GPL-3.0-or-later
"""Isosurfaces of tetrahedral meshes."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..progress import Progress
from ..regions.shapes import Region
from .classification import faces_opposite

# -- Clip a tetrahedral mesh to the planes of a region, keeping it conforming ---------------------
#
# Dropping tetrahedra that reach beyond the region would leave a ragged boundary (docs/method.md,
# section 6.5). Each that a plane crosses is split instead: its part inside becomes up to three
# tetrahedra. The diagonal of a four-sided face depends on the indices of its corners alone, so
# neighbours agree on it regardless of rounding.

_REFERENCE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)

_PRISM_QUADS = ((0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5))
"""Sides of the prism with the triangles 0 1 2 and 3 4 5, where k and k + 3 are opposite."""


@dataclass(frozen=True)
class CutTetrahedra:
    """Tetrahedra clipped to a region."""

    points: np.ndarray  # (n + k, 3) float64: the given points, then those on the region's planes
    tetrahedra: np.ndarray  # (m, 4) int64, face to face, with the given orientation


def cut_to_region(points: np.ndarray, tetrahedra: np.ndarray, region: Region) -> CutTetrahedra:
    """Clip tetrahedra to a region.

    Each edge that a plane crosses gets a new point on that plane. Points on a plane count as
    inside. Connectivity depends on the indices and sides of points alone, so the result is face to
    face, as ``tetrahedra`` (m, 4) are, even where these have no volume.
    """
    local = points - region.center  # (n, 3)
    for normal, offset in zip(*region.half_spaces, strict=True):
        distance = local @ normal - offset  # (n,)
        inside = distance <= 0.0
        code = inside[tetrahedra] @ np.array([1, 2, 4, 8])  # (m,)
        if (code == 15).all():
            continue
        crossed = np.flatnonzero((code > 0) & (code < 15))
        edges, numbers = _crossing_edges(tetrahedra[crossed], inside, len(local))
        share = distance[edges[:, 0]] / (distance[edges[:, 0]] - distance[edges[:, 1]])
        cut_points = local[edges[:, 0]] + share[:, None] * (local[edges[:, 1]] - local[edges[:, 0]])
        # Long edges leave a rounding error.
        cut_points -= (cut_points @ normal - offset)[:, None] * normal
        divided = _split_crossed(tetrahedra[crossed], code[crossed], numbers + len(local))
        tetrahedra = np.concatenate([tetrahedra[code == 15], divided])
        local = np.concatenate([local, cut_points])
    new = local[len(points) :] + region.center
    return CutTetrahedra(np.concatenate([points, new]), tetrahedra)


_EDGES = np.array(list(itertools.combinations(range(4), 2)))
"""(6, 2) corners of the edges of a tetrahedron."""


def _crossing_edges(
    tetrahedra: np.ndarray, inside: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the crossing edges (e, 2), inside point first, and their indices (m, 6) or -1."""
    ends = np.sort(tetrahedra[:, _EDGES], axis=2)  # (m, 6, 2)
    crossing = inside[ends[:, :, 0]] != inside[ends[:, :, 1]]  # (m, 6)
    keys = ends[crossing][:, 0] * np.int64(count) + ends[crossing][:, 1]
    unique, index = np.unique(keys, return_inverse=True)
    numbers = np.full(crossing.shape, -1, np.int64)
    numbers[crossing] = index
    edges = np.stack([unique // count, unique % count], 1)
    return np.where(inside[edges[:, :1]], edges, edges[:, ::-1]), numbers


def _split_crossed(tetrahedra: np.ndarray, codes: np.ndarray, cut_points: np.ndarray) -> np.ndarray:
    """Return the inside parts of crossed tetrahedra, given the new points on their edges (m, 6)."""
    nodes = np.concatenate([tetrahedra, cut_points], 1)  # (m, 10) four corners, six edges
    parts = []
    for code in range(1, 15):
        rows = np.flatnonzero(codes == code)
        if len(rows) == 0:
            continue
        polyhedron = nodes[rows][:, _inside_part(code)]  # (r, 4) or (r, 6)
        if polyhedron.shape[1] == 4:
            parts.append(polyhedron)
            continue
        lowest = polyhedron.argmin(1)
        for first in range(6):
            prism = polyhedron[lowest == first]
            for quad, diagonal, pieces in _prism_parts(first):
                chosen = np.isin(prism[:, quad].argmin(1), diagonal)
                parts.extend(prism[chosen][:, piece] for piece in pieces)
    return np.concatenate(parts) if parts else np.zeros((0, 4), np.int64)


@functools.lru_cache(maxsize=16)
def _inside_part(code: int) -> np.ndarray:
    """Return the inside part as nodes: a tetrahedron (4,) or prism (6,), positively oriented."""
    edge = {frozenset(pair): 4 + k for k, pair in enumerate(_EDGES.tolist())}
    inside = [k for k in range(4) if code >> k & 1]
    outside = [k for k in range(4) if not code >> k & 1]
    if len(inside) == 1:
        polyhedron = inside + [edge[frozenset((inside[0], k))] for k in outside]
    elif len(inside) == 3:
        polyhedron = [edge[frozenset((outside[0], k))] for k in inside] + inside
    else:
        polyhedron = [n for a in inside for n in (a, *(edge[frozenset((a, c))] for c in outside))]
    where = np.concatenate([_REFERENCE, _REFERENCE[_EDGES].mean(1)])[polyhedron]  # (4 or 6, 3)
    if np.linalg.det(where[[1, 2, len(polyhedron) - 1]] - where[0]) < 0:
        half = len(polyhedron) // 2
        swap = [0, 1, 3, 2] if half == 2 else [0, 2, 1, 3, 5, 4]
        polyhedron = [polyhedron[k] for k in swap]
    return np.array(polyhedron)


@functools.lru_cache(maxsize=8)
def _prism_parts(first: int) -> tuple[tuple[list[int], list[int], tuple[list[int], ...]], ...]:
    """Return the splits of a prism whose corner ``first`` has the lowest index.

    The diagonal of each four-sided face starts at its corner with the lowest index. Corner
    ``first`` is joined to the two faces that it does not lie on: a triangle and one four-sided
    face. Returns for each of the two cases the four-sided face, the positions in it that have its
    lowest index in this case, and the three tetrahedra.
    """
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1.0]])
    triangle = [3, 4, 5] if first < 3 else [0, 1, 2]
    quad = next(list(q) for q in _PRISM_QUADS if first not in q)
    a, b, c, d = quad
    cases = []
    for diagonal, halves in (([0, 2], ([a, b, c], [a, c, d])), ([1, 3], ([a, b, d], [b, c, d]))):
        pieces = []
        for face in (triangle, *halves):
            piece = [first, *face]
            if np.linalg.det(corners[piece[1:]] - corners[first]) < 0:
                piece[2], piece[3] = piece[3], piece[2]
            pieces.append(piece)
        cases.append((quad, diagonal, tuple(pieces)))
    return tuple(cases)


# -- Marching tetrahedra on labelled points, and bisection of crossing edges ----------------------
#
# See docs/method.md, section 6.3.

IsEmpty = Callable[[np.ndarray], np.ndarray]  # maps (n, 3) points to (n,) bool: on the empty side

MAX_BISECTIONS = 40


@functools.lru_cache(maxsize=1)
def case_tables() -> tuple[np.ndarray, np.ndarray]:
    """Return the triangle table of all 16 cases.

    Bit k of a case is set where corner k is inside. The table is derived from a reference
    tetrahedron, so that triangles of positively oriented tetrahedra face the empty side.

    Returns the number of triangles of each case, (16,) int64: 0, 1 or 2; and for each triangle
    vertex the (inside, outside) corners of its edge, (16, 2, 3, 2) int64.
    """
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
        middle = np.array([(_REFERENCE[i] + _REFERENCE[k]) / 2 for i, k in polygon])
        normal = np.cross(middle[1] - middle[0], middle[2] - middle[0])
        if normal @ (_REFERENCE[outside].mean(0) - _REFERENCE[inside].mean(0)) < 0:
            polygon.reverse()
        counts[code] = len(polygon) - 2
        for t in range(counts[code]):
            corners[code, t] = [polygon[0], polygon[t + 1], polygon[t + 2]]
    return counts, corners


def marching_tetrahedra(
    tetrahedra: np.ndarray, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the surface between inside and outside points, with vertices on edges.

    ``tetrahedra`` (m, 4) are positively oriented, face to face; ``inside`` (n,) bool labels each
    point. The surface is closed if no point of the hull is inside.
    Returns crossing edges (e, 2) int64 (inside point, outside point), on which the vertices of the
    mesh lie, and faces (f, 3) int64, counter-clockwise seen from the empty side.
    """
    return _indexed(_separating(tetrahedra, inside), len(inside))


def marching_closed(
    tetrahedra: np.ndarray, neighbours: np.ndarray, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the boundary of the inside part of tetrahedra, including caps on their hull.

    The surface is a closed 2-manifold if the tetrahedra are a 3-manifold with boundary: no sign is
    zero, so the isosurface crosses every tetrahedron and every face of the hull transversally.

    ``tetrahedra`` and ``inside`` are those of :func:`marching_tetrahedra`; ``neighbours`` (m, 4)
    those of :func:`.classification.tetrahedron_neighbours`.
    Returns for each vertex of the mesh its crossing edge (inside point, outside point), or an
    inside point of the hull twice, (e, 2) int64; and faces (f, 3) int64, counter-clockwise seen
    from outside.
    """
    pieces = _separating(tetrahedra, inside)
    hull = faces_opposite(tetrahedra, neighbours < 0)  # (h, 3)
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
    inside_points: np.ndarray, outside_points: np.ndarray, is_empty: IsEmpty,
    tolerance: float | np.ndarray, progress: Progress,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Bisect segments until the sign change is bracketed within ``tolerance``.

    Segments that are short enough stop early, which saves evaluations. The ``tolerance`` is the
    largest final length of a bracket, one for all or (n,). Returns the occupied and the empty ends
    of the brackets, (n, 3) float64 each, as they are given.
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
