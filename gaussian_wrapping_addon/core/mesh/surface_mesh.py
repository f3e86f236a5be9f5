# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangle meshes, their file and topology."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..array_file import read_arrays, write_arrays
from ..errors import ParseError

# -- A triangle mesh in the scene frame -----------------------------------------------------------


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles with shared vertices; face normals point to the empty side."""

    vertices: np.ndarray  # (v, 3) float64, scene frame
    faces: np.ndarray  # (f, 3) int32, counter-clockwise seen from outside
    provenance: dict[str, Any] = field(default_factory=dict)
    """How the mesh was made and what was measured, plain JSON values."""


# -- Read and write meshes between stages ---------------------------------------------------------


def save_mesh(path: Path, mesh: SurfaceMesh) -> None:
    """Write vertices, faces and provenance atomically."""
    provenance = np.frombuffer(json.dumps(mesh.provenance).encode(), np.uint8)
    write_arrays(path, vertices=mesh.vertices, faces=mesh.faces, provenance=provenance)


def load_mesh(path: Path) -> SurfaceMesh:
    """Read a file of :func:`save_mesh`; :class:`ParseError` if it is damaged or none."""
    hint = "Delete the folder and run again."
    arrays = read_arrays(path, ("vertices", "faces", "provenance"), hint=hint)
    try:
        provenance = json.loads(arrays["provenance"].tobytes())
        return SurfaceMesh(arrays["vertices"], arrays["faces"], provenance)
    except (ValueError, TypeError) as error:
        raise ParseError(path, "whole file", f"not a mesh file ({error}).", hint) from None


# -- Basic quantities of triangle meshes: normals, areas, half-edges, edges -----------------------
#
# Half-edge ``3 f + k`` leads from corner k of face f to the next corner.


def area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (f, 3) normals with a length of twice the area, in the vertices' dtype."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def normals_and_areas(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (f, 3), zero for degenerate faces, and areas (f,)."""
    cross = area_vectors(vertices, faces)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.where(length > 0, length, 1.0)[:, None], length / 2


def edge_lengths(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (f, 3) lengths; edge k leads from corner k to the next."""
    corners = vertices[faces]  # (f, 3, 3)
    return np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2)


def half_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return begin and end of the half-edges, (3f,) each."""
    return faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)


def next_half_edges(half: np.ndarray) -> np.ndarray:
    """Return the half-edges that follow the given ones in their faces."""
    return half - half % 3 + (half + 1) % 3


def edge_keys(begin: np.ndarray, end: np.ndarray, vertex_count: int) -> np.ndarray:
    """Return one int64 number for each pair of vertices, the same in both directions.

    ``key // vertex_count`` is the lesser vertex, ``key % vertex_count`` the greater one.
    """
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    return np.asarray(low, np.int64) * vertex_count + high


def faces_per_edge(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """Return for each half-edge how many faces its edge has, (3f,) int64."""
    keys = edge_keys(*half_edges(faces), vertex_count)
    _, index, count = np.unique(keys, return_inverse=True, return_counts=True)
    return count[index]


def summed(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return (count, k) float64: the sums of the rows of ``values`` (n, k) with the same index."""
    return np.stack([np.bincount(index, column, count) for column in values.T], axis=1)


def vertices_of_half_edges(chosen: np.ndarray, faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """Return the vertices at the chosen half-edges, (v,) bool; ``chosen`` is (3f,) bool."""
    begin, end = half_edges(faces)
    result = np.zeros(vertex_count, np.bool_)
    result[begin[chosen]] = True
    result[end[chosen]] = True
    return result
