# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh statistics: topology, orientation, components and size."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ...mesh.components import face_components, volumes_and_areas
from ...mesh.surface_mesh import SurfaceMesh
from ...mesh.topology import edge_keys, edge_lengths, half_edges, next_half_edges, normals_and_areas


@dataclass(frozen=True)
class MeshStatistics:
    """Topology and size of a mesh; lengths in the mesh's units."""

    vertices: int
    faces: int
    boundary_edges: int
    """Edges with one face."""
    nonmanifold_edges: int
    """Edges with more than two faces."""
    nonmanifold_vertices: int
    """Vertices whose faces form more than one fan."""
    inconsistent_edges: int
    """Edges whose two faces have opposite orientations."""
    degenerate_faces: int
    """Faces with two equal corners, or with no area in float64."""
    unused_vertices: int
    euler: int
    components: int
    genus: int | None
    """Sum over all parts; ``None`` where the mesh is not a closed 2-manifold."""
    volume: float
    area: float
    mean_edge: float
    closed: bool
    """Every edge has exactly two faces, of one orientation."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)


def mesh_statistics(mesh: SurfaceMesh) -> MeshStatistics:
    """Measure a mesh; any triangle mesh is accepted, also an empty one."""
    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
    begin, end = half_edges(faces)
    keys = edge_keys(begin, end, max(len(vertices), 1))
    edges, index, count = np.unique(keys, return_inverse=True, return_counts=True)
    forward = np.bincount(index, weights=begin < end, minlength=len(edges))
    boundary, nonmanifold = int((count == 1).sum()), int((count > 2).sum())
    inconsistent = int(((count == 2) & (forward != 1)).sum())
    used = len(np.unique(faces))
    parts, part = face_components(len(vertices), faces)
    volume, area = volumes_and_areas(vertices, faces, part, parts)
    _, areas = normals_and_areas(vertices, faces)
    repeated = (faces == faces[:, [1, 2, 0]]).any(1)
    fans = _fans(faces, keys)
    closed = len(faces) > 0 and boundary == 0 and nonmanifold == 0 and inconsistent == 0
    euler = used - len(edges) + len(faces)
    manifold = closed and fans == used
    return MeshStatistics(
        vertices=len(vertices),
        faces=len(faces),
        boundary_edges=boundary,
        nonmanifold_edges=nonmanifold,
        nonmanifold_vertices=fans - used,
        inconsistent_edges=inconsistent,
        degenerate_faces=int((repeated | (areas <= 0)).sum()),
        unused_vertices=len(vertices) - used,
        euler=int(euler),
        components=parts,
        genus=int(parts - euler // 2) if manifold else None,
        volume=float(volume.sum()),
        area=float(area.sum()),
        mean_edge=float(edge_lengths(vertices, faces).mean()) if len(faces) else 0.0,
        closed=closed,
    )


def _fans(faces: np.ndarray, keys: np.ndarray) -> int:
    """Count fans: corners at one vertex, connected across shared edges."""
    corners = np.arange(faces.size)
    following = next_half_edges(corners)
    order = np.argsort(keys, kind="stable")
    same = keys[order[1:]] == keys[order[:-1]]
    first, second = order[:-1][same], order[1:][same]  # half-edges on one edge
    flat = faces.reshape(-1)
    aligned = flat[first] == flat[second]
    rows = np.concatenate([first, following[first]])
    columns = np.concatenate(
        [
            np.where(aligned, second, following[second]),
            np.where(aligned, following[second], second),
        ]
    )
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(faces.size,) * 2)
    return int(connected_components(graph, directed=False)[0]) if faces.size else 0
