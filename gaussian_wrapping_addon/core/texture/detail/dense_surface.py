# SPDX-License-Identifier: GPL-3.0-or-later
"""Ray and nearest-point queries on a dense mesh, to transfer its detail to a lighter one.

Both use libigl's AABB tree in double precision, in coordinates normalised by the centre and size of
the mesh, so that units and large offsets (UTM) do not affect the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import igl
import numpy as np

from ...mesh.surface_mesh import SurfaceMesh
from ...mesh.tangent_frame import shading_normals
from ...mesh.topology import area_vectors

BLOCK = 1 << 16
"""Points per query: bounds memory, and bounds the time for which libigl holds the GIL to a fraction
of a second."""
CAGE_SAMPLES = 20_000
"""Points of each mesh whose distance to the other mesh is measured."""
CAGE_FACTOR = 1.5
"""Margin: detail between the samples may be farther away."""
MIN_CAGE_SHARE = 1e-4
"""Share of the mesh's diagonal: minimum length of a ray, far above rounding."""
RETRY_OFFSET_SHARE = 1e-7
"""Share of the mesh's diagonal by which a ray without a hit is offset and cast again: rays in the
plane of an edge can pass between its two faces."""
RETRY_DIRECTION = np.array([0.5345, 0.2673, 0.8018])
"""Unit direction of that offset, along no likely axis of a mesh."""
NO_HIT, BY_RAY, BY_NEAREST = 0, 1, 2
"""How a correspondence on the dense mesh was found."""


@dataclass(frozen=True)
class SurfaceCorrespondences:
    """Corresponding points on the dense mesh."""

    face: np.ndarray
    """(n,) int64, -1 without a correspondence."""
    weights: np.ndarray
    """(n, 3) float64 barycentric weights of the face's corners."""
    method: np.ndarray
    """(n,) uint8: ``NO_HIT``, ``BY_RAY`` or ``BY_NEAREST``."""


class DenseSurface:
    """A mesh prepared for ray and nearest-point queries, in the mesh's units.

    Parameters
    ----------
    mesh : SurfaceMesh
        Finite, with at least one face with area.
    """

    def __init__(self, mesh: SurfaceMesh) -> None:
        vertices = np.asarray(mesh.vertices, np.float64)
        self.faces = np.ascontiguousarray(mesh.faces, np.int64)
        used = vertices[self.faces.ravel()]
        low, high = used.min(axis=0), used.max(axis=0)
        self._centre, self.size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        self.vertices = vertices
        self.vertex_normals = shading_normals(vertices, self.faces)
        self._local = (vertices - self._centre) / self.size
        self.face_normals = area_vectors(self._local, self.faces)
        self._tree = igl.AABB()
        self._tree.init(self._local, self.faces)

    def normals(self, matches: SurfaceCorrespondences) -> np.ndarray:
        """Return (n, 3) float64 interpolated unit normals; that of the face if they cancel."""
        corners = self.vertex_normals[self.faces[matches.face]]  # (n, 3, 3)
        normals = np.einsum("nc,ncx->nx", matches.weights, corners)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        flat = self.face_normals[matches.face]
        flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
        return np.where(length > 1e-6, normals / np.maximum(length, 1e-6), flat)

    def points(self, matches: SurfaceCorrespondences) -> np.ndarray:
        """Return (n, 3) float64 positions."""
        return np.einsum("nc,ncx->nx", matches.weights, self.vertices[self.faces[matches.face]])

    def first_hits(
        self, points: np.ndarray, directions: np.ndarray, reach: float
    ) -> SurfaceCorrespondences:
        """Return the first hit of each ray within ``reach``, on either side of a face.

        Parameters
        ----------
        points, directions : (n, 3) float64
            Unit directions.
        reach : float
        """
        count = len(points)
        face = np.full(count, -1, np.int64)
        weights = np.zeros((count, 3))
        for begin, end in _blocks(count):
            index, _, pair = self._cast(points[begin:end], directions[begin:end], reach)
            face[begin:end] = index
            weights[begin:end, 1:] = np.where(index[:, None] >= 0, pair, 0.0)
        weights[:, 0] = 1.0 - weights[:, 1] - weights[:, 2]
        return SurfaceCorrespondences(
            face, weights, np.where(face >= 0, BY_RAY, NO_HIT).astype(np.uint8)
        )

    def is_hit(self, points: np.ndarray, directions: np.ndarray, reach: float) -> np.ndarray:
        """Return whether each ray hits the mesh within ``reach``, (n,) bool."""
        hit = np.zeros(len(points), np.bool_)
        for begin, end in _blocks(len(points)):
            hit[begin:end] = self._cast(points[begin:end], directions[begin:end], reach)[0] >= 0
        return hit

    def _cast(
        self, points: np.ndarray, directions: np.ndarray, reach: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        local = np.ascontiguousarray((points - self._centre) / self.size)
        rays = np.ascontiguousarray(directions, np.float64)
        return self._tree.intersect_ray_first(
            self._local, self.faces, local, rays, reach / self.size
        )

    def nearest(self, points: np.ndarray) -> tuple[SurfaceCorrespondences, np.ndarray]:
        """Return the nearest point on the mesh for each point, and the (n,) float64 distances."""
        count = len(points)
        face, distance = np.zeros(count, np.int64), np.zeros(count)
        weights = np.zeros((count, 3))
        for begin, end in _blocks(count):
            local = np.ascontiguousarray((points[begin:end] - self._centre) / self.size)
            square, index, closest = self._tree.squared_distance(self._local, self.faces, local)
            face[begin:end] = index
            distance[begin:end] = np.sqrt(np.maximum(square, 0.0)) * self.size
            weights[begin:end] = _barycentric(closest, self._local[self.faces[index]])
        return SurfaceCorrespondences(face, weights, np.full(count, BY_NEAREST, np.uint8)), distance

    def correspondences(
        self, points: np.ndarray, normals: np.ndarray, reach: float
    ) -> SurfaceCorrespondences:
        """Find the points on this mesh that correspond to points of a lighter one.

        Rays are cast in both directions along the normal. A first hit counts if the face normal
        agrees with the normal of the point; another sheet, such as the other side of a plate, is
        hit from the wrong side and does not count. Of two hits the nearer one is used; without a
        hit, the nearest point, if its face normal agrees.

        Parameters
        ----------
        points, normals : (n, 3) float64
            Unit normals.
        reach : float
            Length of the rays: :func:`cage_distance`.
        """
        face = np.full(len(points), -1, np.int64)
        weights = np.zeros((len(points), 3))
        for shift in (0.0, RETRY_OFFSET_SHARE * self.size):
            left = np.flatnonzero(face < 0)
            self._by_rays(points + shift * RETRY_DIRECTION, normals, reach, left, face, weights)
        method = np.where(face >= 0, BY_RAY, NO_HIT).astype(np.uint8)
        left = np.flatnonzero(face < 0)
        if len(left):
            matches, _ = self.nearest(points[left])
            agrees = (self.face_normals[matches.face] * normals[left]).sum(axis=1) > 0.0
            rows = left[agrees]
            face[rows], weights[rows] = matches.face[agrees], matches.weights[agrees]
            method[rows] = BY_NEAREST
        return SurfaceCorrespondences(face, weights, method)

    def _by_rays(
        self,
        points: np.ndarray,
        normals: np.ndarray,
        reach: float,
        wanted: np.ndarray,
        face: np.ndarray,
        weights: np.ndarray,
    ) -> None:
        """Set the nearer accepted hit of the ``wanted`` points."""
        best = np.full(len(points), np.inf)
        for sign in (1.0, -1.0):
            hits = self.first_hits(points[wanted], sign * normals[wanted], reach)
            hit = hits.face >= 0
            rows = wanted[hit]
            part = SurfaceCorrespondences(hits.face[hit], hits.weights[hit], hits.method[hit])
            away = np.linalg.norm(self.points(part) - points[rows], axis=1)
            agrees = (self.face_normals[part.face] * normals[rows]).sum(axis=1) > 0.0
            better = agrees & (away < best[rows])
            rows = rows[better]
            best[rows] = away[better]
            face[rows], weights[rows] = part.face[better], part.weights[better]


def cage_distance(light: SurfaceMesh, light_surface: DenseSurface, dense: DenseSurface) -> float:
    """Return the required length of rays from one mesh to the other: slightly over their distance.

    Measured in both directions at up to :data:`CAGE_SAMPLES` points of each mesh.
    """
    middles = np.asarray(light.vertices, np.float64)[light.faces].mean(axis=1)
    one = dense.nearest(_spread(middles))[1].max()
    corners = dense.vertices[np.unique(dense.faces)]
    other = light_surface.nearest(_spread(corners))[1].max()
    return max(CAGE_FACTOR * float(max(one, other)), MIN_CAGE_SHARE * dense.size)


def _spread(points: np.ndarray) -> np.ndarray:
    """Return at most ``CAGE_SAMPLES`` of the points, evenly spaced by index."""
    return points[np.unique(np.linspace(0, len(points) - 1, CAGE_SAMPLES).astype(np.int64))]


def _blocks(count: int) -> Iterator[tuple[int, int]]:
    return ((begin, min(begin + BLOCK, count)) for begin in range(0, count, BLOCK))


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return (n, 3) barycentric weights of points; equal ones for triangles without area."""
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = points - corners[:, 0]
    a, b, c = (one * one).sum(1), (one * other).sum(1), (other * other).sum(1)
    d, e = (offset * one).sum(1), (offset * other).sum(1)
    determinant = a * c - b * b
    flat = determinant <= 1e-12 * np.maximum(a, c) ** 2
    safe = np.where(flat, 1.0, determinant)
    second = np.where(flat, 1.0 / 3.0, (c * d - b * e) / safe).clip(0.0, 1.0)
    third = np.where(flat, 1.0 / 3.0, (a * e - b * d) / safe).clip(0.0, 1.0)
    return np.stack([1.0 - second - third, second, third], axis=1)
