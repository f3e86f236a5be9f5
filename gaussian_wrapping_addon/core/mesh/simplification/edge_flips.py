# SPDX-License-Identifier: GPL-3.0-or-later
"""Flip edges of a coarse closed mesh to approximate the dense mesh that it was simplified from.

Half-edge collapses leave the edges in arbitrary directions. Flipping some of them lowers the
surface error of an adaptive mesh by a tenth, with the same vertices.
"""

from __future__ import annotations

import igl
import numpy as np

from ...kernels.compiled import kernel
from ..topology import edge_keys, normals_and_areas
from .vertex_selection import LEAST_COSINE, LEAST_ROUNDNESS

PASSES = 6
"""Nearly all flips happen in the first two; the third and fourth find a few more."""

LEAST_GAIN = 0.02
"""Share of the error of two triangles that a flip must save; below it, rounding would decide."""

FLAT_HEIGHT = 1e-4
"""Errors below this share of the edges are ignored: flat parts are not changed."""


def flip_edges(
    vertices: np.ndarray,
    faces: np.ndarray,
    dense_vertices: np.ndarray,
    dense_faces: np.ndarray,
    longest: float,
    movable: np.ndarray | None = None,
) -> np.ndarray:
    """Flip edges while that brings the faces closer to a dense mesh of the same surface.

    Vertices, genus and parts do not change; no face turns over or becomes narrow. The error of a
    triangle is computed from the heights of the surface over the midpoints of its edges, with a
    quadratic model of the surface.

    Parameters
    ----------
    vertices : (v, 3) float64
        On the dense mesh.
    faces : (f, 3) int64
        A closed 2-manifold.
    dense_vertices : (n, 3) float64
    dense_faces : (m, 3) int64
        Oriented alike.
    longest : float
        Greatest length of a new edge.
    movable : (f,) bool, optional
        For a part of a mesh: faces that may change. All faces at their corners are given.

    Returns
    -------
    (f, 3) int64
    """
    faces = np.array(faces, np.int64)
    if len(faces) == 0 or len(dense_faces) == 0:
        return faces
    low, high = dense_vertices.min(0), dense_vertices.max(0)
    # Relative to the mesh: far from the origin nearest points would be rounded.
    points = vertices - (low + high) / 2
    surface = _SurfaceHeights(points, dense_vertices - (low + high) / 2, dense_faces)
    for _ in range(PASSES):
        chosen = _one_pass(points, faces, surface, longest, movable)
        if chosen == 0:
            break
    return faces


class _SurfaceHeights:
    """Heights of the surface over the midpoints of edges, each computed once."""

    def __init__(self, points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._points, self._count = points, len(points)
        self._vertices = np.ascontiguousarray(vertices, np.float64)
        self._faces = np.ascontiguousarray(faces, np.int64)
        self._normals, _ = normals_and_areas(self._vertices, self._faces)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        self._keys = np.zeros(0, np.int64)
        self._heights, self._up = np.zeros(0), np.zeros((0, 3))

    def key(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return a key for each pair of vertices, independent of their order."""
        return edge_keys(a, b, self._count)

    def over(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return heights (k,), negative inside, and normals (k, 3) of the surface there."""
        wanted = self.key(a, b)
        fresh = np.setdiff1d(wanted, self._keys)
        if len(fresh):
            middle = (self._points[fresh // self._count] + self._points[fresh % self._count]) / 2
            _, face, nearest = self._tree.squared_distance(self._vertices, self._faces, middle)
            up, away = self._normals[face], middle - nearest
            height = np.copysign(np.linalg.norm(away, axis=1), (away * up).sum(1))
            order = np.argsort(np.concatenate([self._keys, fresh]), kind="stable")
            self._keys = np.concatenate([self._keys, fresh])[order]
            self._heights = np.concatenate([self._heights, height])[order]
            self._up = np.concatenate([self._up, up])[order]
        at = np.searchsorted(self._keys, wanted)
        return self._heights[at], self._up[at]


def _one_pass(
    points: np.ndarray,
    faces: np.ndarray,
    surface: _SurfaceHeights,
    longest: float,
    movable: np.ndarray | None,
) -> int:
    """Flip the best edges, no two in the same face, in place; return their number."""
    # Half-edge 3 f + k leads from corner k of face f to the next, opposite the third.
    start, end, tip = (np.roll(faces, -k, 1).ravel() for k in range(3))
    backward = end * len(points) + start
    forward = start * len(points) + end
    order = np.argsort(forward)
    twin = order[np.minimum(np.searchsorted(forward[order], backward), len(order) - 1)]
    one = np.flatnonzero(start < end)
    if movable is not None:
        one = one[forward[twin[one]] == backward[one]]
        one = one[movable[one // 3] & movable[twin[one] // 3]]
    other = twin[one]
    a, b, c, d = start[one], end[one], tip[one], tip[other]

    # Cheap tests first: shapes of the two new faces, and that their edge does not exist yet.
    normal_1, area_1, round_1 = _shapes(points, a, b, c)
    normal_2, area_2, round_2 = _shapes(points, b, a, d)
    normal_3, area_3, round_3 = _shapes(points, a, d, c)
    normal_4, area_4, round_4 = _shapes(points, d, b, c)
    up = normal_1 * area_1[:, None] + normal_2 * area_2[:, None]
    up /= np.maximum(np.linalg.norm(up, axis=1), 1e-300)[:, None]
    least = np.minimum(LEAST_ROUNDNESS, np.minimum(round_1, round_2))
    allowed = np.minimum(round_3, round_4) >= least
    for normal in (normal_3, normal_4):
        allowed &= (normal * up).sum(1) > LEAST_COSINE
    allowed &= (normal_3 * normal_4).sum(1) > 0.0
    allowed &= np.linalg.norm(points[c] - points[d], axis=1) <= longest
    edges = surface.key(a, b) if movable is None else surface.key(start, end)
    allowed &= ~np.isin(surface.key(c, d), edges)

    rows = np.flatnonzero(allowed)
    one, other, a, b, c, d = (x[rows] for x in (one, other, a, b, c, d))
    across, there = surface.over(c, d)
    along, bc, ca = surface.over(a, b)[0], surface.over(b, c)[0], surface.over(c, a)[0]
    ad, db = surface.over(a, d)[0], surface.over(d, b)[0]
    before = _error(area_1[rows], along, bc, ca) + _error(area_2[rows], along, ad, db)
    after = _error(area_3[rows], ad, across, ca) + _error(area_4[rows], db, bc, across)
    flat = FLAT_HEIGHT * (area_1 + area_2)[rows] ** 1.5
    # Where the nearest surface is the far side of a thin wall, the height is unknown.
    good = (after < (1.0 - LEAST_GAIN) * before) & (before > flat)
    good &= (there * up[rows]).sum(1) > LEAST_COSINE
    best = np.flatnonzero(good)
    best = best[np.argsort((after - before)[best], kind="stable")]
    faces_1, faces_2 = one[best] // 3, other[best] // 3
    keys, number = np.unique(surface.key(c, d)[best], return_inverse=True)
    best = best[_independent(faces_1, faces_2, number, len(faces), len(keys))]
    a, b, c, d = a[best], b[best], c[best], d[best]
    faces[one[best] // 3] = np.stack([a, d, c], 1)
    faces[other[best] // 3] = np.stack([d, b, c], 1)
    return len(best)


def _shapes(
    points: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit normals, areas, and twice the area over the longest edge squared."""
    first, second = points[b] - points[a], points[c] - points[a]
    cross = np.cross(first, second)
    length = np.linalg.norm(cross, axis=1)
    longest = np.maximum((first**2).sum(1), (second**2).sum(1))
    longest = np.maximum(longest, ((second - first) ** 2).sum(1))
    normal = cross / np.maximum(length, 1e-300)[:, None]
    return normal, length / 2, length / np.maximum(longest, 1e-300)


def _error(area: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the area times the root mean square height of ``4 (x l1 l2 + y l2 l3 + z l3 l1)``.

    That is the quadratic surface through the corners, with these heights over the midpoints of the
    edges; l are barycentric coordinates, and the mean of (4 l1 l2)^2 is 8 / 45.
    """
    return area * np.sqrt(8.0 / 45.0 * (x * x + y * y + z * z + x * y + y * z + z * x))


@kernel(fast=False)
def _independent(faces_1, faces_2, edge, face_count, edge_count):  # type: ignore[no-untyped-def]
    """Select flips in order, such that no face and no new edge is used twice."""
    locked, made = np.zeros(face_count, np.bool_), np.zeros(edge_count, np.bool_)
    taken = np.zeros(len(faces_1), np.bool_)
    for i in range(len(faces_1)):
        if locked[faces_1[i]] or locked[faces_2[i]] or made[edge[i]]:
            continue
        locked[faces_1[i]], locked[faces_2[i]], made[edge[i]] = True, True, True
        taken[i] = True
    return taken
