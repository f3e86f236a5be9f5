# SPDX-License-Identifier: GPL-3.0-or-later
"""Connected components of faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .surface_mesh import (
    area_vectors,
    edge_keys,
    half_edges,
    next_half_edges,
    normals_and_areas,
    summed,
)

# -- Face adjacency of a triangle mesh, face normals and areas, and UV charts ---------------------


def connected(one: np.ndarray, other: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    """Return the number of parts that pairs of ``count`` members form, and the part of each."""
    pairs = coo_matrix((np.ones(len(one), np.int8), (one, other)), shape=(count, count))
    parts, label = connected_components(pairs, directed=False)
    return int(parts), label


@dataclass(frozen=True)
class FaceGraph:
    """Adjacency and measures of the faces of a mesh."""

    opposite: np.ndarray
    """(f, 3) int32: half-edge ``3 * g + j`` across the edge from corner k to k + 1, or -1."""
    normals: np.ndarray  # (f, 3) float64 unit normals; zero for faces without area
    areas: np.ndarray  # (f,) float64, square scene units
    centroids: np.ndarray  # (f, 3) float64


def face_graph(vertices: np.ndarray, faces: np.ndarray) -> FaceGraph:
    """Build the graph; edges that do not have exactly two faces are borders."""
    vertices = np.asarray(vertices, np.float64)
    normals, areas = normals_and_areas(vertices, faces)
    return FaceGraph(_opposite(faces), normals, areas, vertices[faces].mean(axis=1))


def _opposite(faces: np.ndarray) -> np.ndarray:
    key = edge_keys(*half_edges(faces), int(faces.max()) + 1)
    order = np.argsort(key, kind="stable")
    _, first, counts = np.unique(key[order], return_index=True, return_counts=True)
    first = first[counts == 2]
    one, other = order[first], order[first + 1]
    good = one // 3 != other // 3  # a face that uses an edge twice is degenerate
    one, other = one[good], other[good]
    opposite = np.full(faces.size, -1, np.int32)
    opposite[one], opposite[other] = other, one
    return opposite.reshape(-1, 3)


def components(graph: FaceGraph, joined: np.ndarray) -> np.ndarray:
    """Label the connected components of faces.

    ``joined`` (f, 3) bool tells whether the edge at that corner connects its faces; both sides must
    agree. Returns (f,) int32 labels from 0, in order of first appearance.
    """
    face, corner = np.nonzero(joined & (graph.opposite >= 0))
    _, labels = connected(face, graph.opposite[face, corner] // 3, len(graph.opposite))
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first), dtype=np.int32)
    return rank[inverse]


def uv_charts(graph: FaceGraph, faces: np.ndarray, corner_uvs: np.ndarray) -> np.ndarray:
    """Label UV charts, (f,) int32 from 0: faces joined by edges whose UVs agree on both sides."""
    uvs = corner_uvs.reshape(-1, 2)
    vertex = faces.ravel()
    here = np.arange(faces.size).reshape(-1, 3)  # half-edge = its first corner
    here_next = next_half_edges(here)
    there = np.where(graph.opposite >= 0, graph.opposite, 0)
    there_next = next_half_edges(there)
    same_way = vertex[there] == vertex[here]
    match = np.where(same_way, there, there_next)
    match_next = np.where(same_way, there_next, there)
    joined = (uvs[here] == uvs[match]).all(-1) & (uvs[here_next] == uvs[match_next]).all(-1)
    return components(graph, joined)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (v, 3) float64 area-weighted unit normals; zero where undefined."""
    cross = area_vectors(np.asarray(vertices, np.float64), faces)
    total = summed(faces.ravel(), np.repeat(cross, 3, axis=0), len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0, length, 1.0)


# -- Connected parts of a mesh, and removal of floaters -------------------------------------------


def face_components(vertex_count: int, faces: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of connected components and the component of each face, (f,) int64.

    Faces that share a vertex belong to one component.
    """
    if len(faces) == 0:
        return 0, np.zeros(0, np.int64)
    _, label = connected(*half_edges(faces), vertex_count)
    used, part = np.unique(label[faces[:, 0]], return_inverse=True)
    return len(used), part


def volumes_and_areas(
    vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed volume and the area of each component, (count,) each.

    The volume is meaningful for closed components; a cavity inside a solid has a negative one.
    """
    center = vertices[faces.reshape(-1)].mean(0) if len(faces) else np.zeros(3)
    a, b, c = (vertices[faces[:, k]] - center for k in range(3))
    each = (a * np.cross(b, c)).sum(1) / 6.0
    _, areas = normals_and_areas(vertices, faces)
    return np.bincount(part, each, count), np.bincount(part, areas, count)


@dataclass(frozen=True)
class FloaterRemoval:
    """Result of :func:`without_floaters`."""

    faces: np.ndarray  # (g, 3) remaining faces
    kept: int
    removed_solids: int
    removed_cavities: int
    removed_area_share: float  # area of the removed components, as a share of the total

    @property
    def removed(self) -> int:
        """All removed components: the volume of open ones does not tell solids from cavities."""
        return self.removed_solids + self.removed_cavities

    def figures(self) -> dict[str, Any]:
        """Return what the provenance of a mesh says about it."""
        names = ("removed_solids", "removed_cavities", "removed_area_share")
        return {"components": self.kept, **{name: getattr(self, name) for name in names}}


LONG_FACTOR = 3.0
"""A component longer than this many times its least share of the longest is no floater: a piece of
wire has little area and may be all that is left of it."""
LONG_FACES = 30
"""With fewer faces a long component is a sliver between a few vertices, not a structure."""


def _extents(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, count: int) -> np.ndarray:
    """Return the diagonal of the bounding box of each component, (count,)."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    corners = vertices[faces]  # (f, 3, 3)
    np.minimum.at(low, part, corners.min(1))
    np.maximum.at(high, part, corners.max(1))
    return np.asarray(np.linalg.norm(np.maximum(high - low, 0.0), axis=1))


def without_floaters(
    vertices: np.ndarray,
    faces: np.ndarray,
    min_share: float,
    most: int = 0,
    stand_for: np.ndarray | None = None,
) -> FloaterRemoval:
    """Remove components that are small both in area and in length.

    A component is removed if its area is below ``min_share`` of the largest one's, and its length
    is below :data:`LONG_FACTOR` times that share of the longest one's or it has fewer than
    :data:`LONG_FACES` faces. Small cavities are removed as well, which fills them; a cavity of a
    removed solid is always small.

    Of what is left the ``most`` solids of the largest area stay, with their cavities; 0 for all.
    ``stand_for`` (f,) is how many faces of a dense mesh each one counts as, 1 without it.
    """
    count, part = face_components(len(vertices), faces)
    volume, area = volumes_and_areas(vertices, faces, part, count)
    length = _extents(vertices, faces, part, count)
    keep = area >= min_share * area.max(initial=0.0)
    long = length >= LONG_FACTOR * min_share * length.max(initial=0.0)
    keep |= long & (np.bincount(part, stand_for, minlength=count) >= LONG_FACES)
    if most:
        keep &= _largest(vertices, faces, part, np.where(keep, volume, np.nan), area, most)
    return FloaterRemoval(
        faces[keep[part]], int(keep.sum()),
        int((~keep & (volume >= 0)).sum()), int((~keep & (volume < 0)).sum()),
        float(area[~keep].sum() / max(area.sum(), 1e-300)),
    )  # fmt: skip


def _largest(
    vertices: np.ndarray, faces: np.ndarray, part: np.ndarray,
    volume: np.ndarray, area: np.ndarray, most: int,
) -> np.ndarray:  # fmt: skip
    """Return (count,) bool: the largest solids, and the cavities inside of them.

    ``volume`` is NaN for components that do not count.
    """
    solids = np.flatnonzero(volume >= 0)
    kept = np.zeros(len(volume), bool)
    kept[solids[np.argsort(-area[solids], kind="stable")[:most]]] = True
    of_kept = faces[kept[part]]
    for cavity in np.flatnonzero(volume < 0):
        corner = vertices[faces[np.argmax(part == cavity), 0]]
        kept[cavity] = winding_number(corner, vertices, of_kept) > 0.5
    return kept


def winding_number(point: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return how often closed, outward faces wind around a point: 1 inside, 0 outside.

    By solid angles (Van Oosterom and Strackee, "The solid angle of a plane triangle", 1983).
    """
    a, b, c = (vertices[faces[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = la * lb * lc
    for x, y, length in ((a, b, lc), (b, c, la), (c, a, lb)):
        denominator += np.einsum("ij,ij->i", x, y) * length
    return float(np.arctan2(numerator, denominator).sum() / (2.0 * np.pi))


def compacted(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drop unused vertices; return the others (w, 3), (f, 3) int64 faces and (w,) old indices."""
    source, index = np.unique(faces, return_inverse=True)
    return vertices[source], index.reshape(-1, 3).astype(np.int64), source
