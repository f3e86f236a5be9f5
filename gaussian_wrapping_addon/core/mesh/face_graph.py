# SPDX-License-Identifier: GPL-3.0-or-later
"""Face adjacency of a triangle mesh, face normals and areas, and UV charts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .topology import area_vectors, edge_keys, half_edges, normals_and_areas


@dataclass(frozen=True)
class FaceGraph:
    """Adjacency and measures of the faces of a mesh."""

    opposite: np.ndarray
    """(f, 3) int32: half-edge ``3 * g + j`` across the edge from corner k to k + 1, or -1."""
    normals: np.ndarray
    """(f, 3) float64 unit normals; zero for faces without area."""
    areas: np.ndarray
    """(f,) float64, square scene units."""
    centroids: np.ndarray
    """(f, 3) float64."""


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

    Parameters
    ----------
    joined : (f, 3) bool
        Whether the edge at that corner connects its faces; must agree on both sides.

    Returns
    -------
    (f,) int32
        Labels from 0, in order of first appearance.
    """
    count = len(graph.opposite)
    face, corner = np.nonzero(joined & (graph.opposite >= 0))
    other = graph.opposite[face, corner] // 3
    adjacency = coo_matrix((np.ones(len(face), np.int8), (face, other)), shape=(count, count))
    labels = connected_components(adjacency, directed=False)[1]
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first), dtype=np.int32)
    return rank[inverse]


def uv_charts(graph: FaceGraph, faces: np.ndarray, corner_uvs: np.ndarray) -> np.ndarray:
    """Label UV charts: faces joined by edges whose UVs agree on both sides.

    Returns
    -------
    (f,) int32
        Labels from 0.
    """
    uvs = corner_uvs.reshape(-1, 2)
    vertex = faces.ravel()
    here = np.arange(faces.size).reshape(-1, 3)  # half-edge = its first corner
    here_next = np.roll(here, -1, axis=1)
    there = np.where(graph.opposite >= 0, graph.opposite, 0)
    there_next = there - there % 3 + (there % 3 + 1) % 3
    same_way = vertex[there] == vertex[here]
    match = np.where(same_way, there, there_next)
    match_next = np.where(same_way, there_next, there)
    joined = (uvs[here] == uvs[match]).all(-1) & (uvs[here_next] == uvs[match_next]).all(-1)
    return components(graph, joined & (graph.opposite >= 0))


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (v, 3) float64 area-weighted unit normals; zero where undefined."""
    cross = area_vectors(np.asarray(vertices, np.float64), faces)
    total = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(cross[:, axis], 3), len(vertices))
            for axis in range(3)
        ],
        axis=1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0, length, 1.0)
