# SPDX-License-Identifier: GPL-3.0-or-later
"""The last check of a mesh, and statistics for the report."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..mesh.components import connected, face_components, volumes_and_areas
from ..mesh.surface_mesh import (
    SurfaceMesh,
    edge_keys,
    edge_lengths,
    half_edges,
    next_half_edges,
    normals_and_areas,
)
from ..regions.shapes import Region

# -- Mesh statistics: topology, orientation, components and size ----------------------------------


@dataclass(frozen=True)
class MeshStatistics:
    """Topology and size of a mesh; lengths in the mesh's units."""

    vertices: int
    faces: int
    boundary_edges: int  # edges with one face
    nonmanifold_edges: int  # edges with more than two faces
    nonmanifold_vertices: int  # vertices whose faces form more than one fan
    inconsistent_edges: int  # edges whose two faces have opposite orientations
    degenerate_faces: int  # faces with two equal corners, or with no area in float64
    unused_vertices: int
    euler: int
    components: int
    genus: int | None  # sum over all parts; ``None`` where the mesh is not a closed 2-manifold
    volume: float
    area: float
    mean_edge: float
    closed: bool  # every edge has exactly two faces, of one orientation

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
    following = next_half_edges(np.arange(faces.size))
    order = np.argsort(keys, kind="stable")
    same = keys[order[1:]] == keys[order[:-1]]
    first, second = order[:-1][same], order[1:][same]  # half-edges on one edge
    aligned = faces.ravel()[first] == faces.ravel()[second]
    begin, end = np.where(aligned, [second, following[second]], [following[second], second])
    rows, columns = np.r_[first, following[first]], np.r_[begin, end]
    return connected(rows, columns, faces.size)[0] if faces.size else 0


# -- Validate that a mesh is an oriented 2-manifold, independently of the code that made it -------
#
# The checks share no code with :mod:`.repair` and the statistics above but scipy's connected
# components, so that a bug there does not hide itself here.

MIN_HEIGHT_SHARE = 1e-6
"""A face with a height below this share of its longest edge counts as degenerate. Files hold
float32, about seven digits: below that a face has no defined normal."""

ON_PLANE_SHARE = 1e-7
"""Tolerance for a vertex on the plane of a region's face, in diagonals of the region: float32
resolves no less."""

MAX_LISTED_PARTS = 20  # the report lists this many of the largest parts


@dataclass(frozen=True)
class CheckedComponent:
    """A part connected by shared vertices."""

    faces: int
    euler: int
    genus: int | None  # ``None`` where the mesh is not a closed oriented 2-manifold
    volume: float  # negative for a cavity; in the mesh's units


@dataclass(frozen=True)
class ManifoldCheck:
    """Defects of a mesh; a valid one has counts of 0 and a positive ``volume``."""

    faces: int
    bad_indices: int  # faces with an index out of range; they are left out of all other counts
    not_finite_vertices: int
    unused_vertices: int
    open_edges: int  # edges with one face
    nonmanifold_edges: int  # edges with more than two faces
    inconsistent_edges: int  # edges whose two faces have opposite orientations
    nonmanifold_vertices: int  # vertices whose faces form more than one ring
    degenerate_faces: int
    """Faces with a repeated corner, or with a height below :data:`MIN_HEIGHT_SHARE`."""
    euler: int
    volume: float
    parts: tuple[CheckedComponent, ...]  # from the largest number of faces to the smallest
    open_at_region: int | None = None
    """Open edges that lie on one plane of the region's boundary; ``None`` if the mesh must be
    closed."""

    @property
    def good(self) -> bool:
        """Whether the mesh is an oriented 2-manifold without defects."""
        return not self.defects()

    def defects(self) -> list[str]:
        """Return descriptions of the defects, none for a good mesh.

        It must be closed with positive volume, or, if requested, open on the region's planes alone.
        """
        if self.faces == 0:
            return ["the mesh has no faces"]
        counted = (
            (self.bad_indices, "faces refer to vertices that do not exist"),
            (self.not_finite_vertices, "vertices are not finite"),
            (self.unused_vertices, "vertices belong to no face"),
            (self.open_edges - (self.open_at_region or 0), "edges have one face only"),
            (self.nonmanifold_edges, "edges have more than two faces"),
            (self.inconsistent_edges, "edges have faces of opposite orientation"),
            (self.nonmanifold_vertices, "vertices join more than one ring of faces"),
            (self.degenerate_faces, "faces have no area"),
        )
        found = [f"{words}: {count}" for count, words in counted if count]
        if self.open_at_region is None and not self.volume > 0.0:
            found.append("the enclosed volume is not positive")
        return found

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values, with ``good``, ``defects`` and the number of parts."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        values["parts"] = [dataclasses.asdict(part) for part in self.parts[:MAX_LISTED_PARTS]]
        for holder in (values, *values["parts"]):
            if not np.isfinite(holder["volume"]):
                holder["volume"] = None
        defects = self.defects()
        return {**values, "part_count": len(self.parts), "good": not defects, "defects": defects}


def validate_manifold(
    vertices: np.ndarray, faces: np.ndarray, open_at: Region | None = None
) -> ManifoldCheck:
    """Check a triangle mesh; any input is accepted, also an empty mesh.

    Faces are counter-clockwise seen from outside. The faces of ``open_at`` may hold boundary edges.
    """
    vertices = np.asarray(vertices, np.float64).reshape(-1, 3)
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    given, count = len(faces), len(vertices)
    faces = faces[((faces >= 0) & (faces < count)).all(1)]
    repeated = (faces == np.roll(faces, 1, axis=1)).any(1)
    used = np.zeros(count, np.bool_)
    used[faces] = True
    edges = _Edges(faces, count)
    sound = edges.open + edges.nonmanifold + edges.inconsistent == 0 and not repeated.any()
    parted = _nonmanifold_vertices(faces, count)
    corners = vertices[faces]  # (f, 3, 3)
    parts, volume = _measure_parts(
        corners, faces, _parts(faces, count), edges, sound and parted == 0
    )
    allowed = None if open_at is None else _on_boundary(vertices, edges.open_pairs, open_at)
    return ManifoldCheck(
        faces=given,
        bad_indices=given - len(faces),
        not_finite_vertices=int((~np.isfinite(vertices).all(1)).sum()),
        unused_vertices=int((~used).sum()),
        open_edges=edges.open,
        nonmanifold_edges=edges.nonmanifold,
        inconsistent_edges=edges.inconsistent,
        nonmanifold_vertices=parted,
        degenerate_faces=int((repeated | _degenerate(corners)).sum()),
        euler=int(used.sum()) - edges.count + len(faces),
        volume=volume,
        parts=parts,
        open_at_region=allowed,
    )


class _Edges:
    """Edges of a mesh; half-edge ``3 f + k`` leads from corner k of face f to the next."""

    def __init__(self, faces: np.ndarray, vertex_count: int) -> None:
        begin, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
        forward, backward = begin * vertex_count + end, end * vertex_count + begin
        unique_edges, self.edge_index, sizes = np.unique(
            np.minimum(forward, backward), return_inverse=True, return_counts=True
        )
        self.count = len(unique_edges)
        self.open, self.nonmanifold = int((sizes == 1).sum()), int((sizes > 2).sum())
        once = sizes[self.edge_index] == 1
        self.open_pairs = np.stack([begin[once], end[once]], 1)  # (o, 2)
        balance = np.bincount(self.edge_index, weights=np.where(begin < end, 1.0, -1.0))
        self.inconsistent = int(((sizes == 2) & (balance != 0)).sum()) if len(unique_edges) else 0


def _on_boundary(vertices: np.ndarray, pairs: np.ndarray, region: Region) -> int:
    """Count the edges (o, 2) with both end points on one plane of the region."""
    found = np.zeros(len(pairs), np.bool_)
    for normal, offset in zip(*region.half_spaces, strict=True):
        away = np.abs((vertices[pairs] - region.center) @ normal - offset)  # (o, 2)
        found |= (away <= ON_PLANE_SHARE * region.diagonal).all(1)
    return int(found.sum())


def _nonmanifold_vertices(faces: np.ndarray, vertex_count: int) -> int:
    """Count vertices whose faces form more than one piece: the edges opposite to them do."""
    if len(faces) == 0:
        return 0
    keys = [(faces * vertex_count + np.roll(faces, -k, axis=1)).ravel() for k in (1, 2)]
    ends, index = np.unique(np.concatenate(keys), return_inverse=True)
    one, other = index.reshape(2, -1)
    count, label = connected(one, other, len(ends))
    owner = np.zeros(count, np.int64)
    owner[label] = ends // vertex_count
    return int((np.bincount(owner) > 1).sum())


def _parts(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """Label each face by the least vertex of its part, (f,) int64."""
    begin, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    _, label = connected(begin, end, max(vertex_count, 1))
    return np.unique(label, return_index=True)[1][label[faces[:, 0]]]


def _degenerate(corners: np.ndarray) -> np.ndarray:
    """(f,) bool: faces with a height below the tolerance; faces that are not finite count."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    sides = np.stack([b - a, c - b, a - c], 1)  # (f, 3, 3)
    with np.errstate(invalid="ignore", over="ignore"):
        longest = np.sqrt((sides**2).sum(2)).max(1, initial=0.0)
        unit = sides / np.where(longest > 0, longest, 1.0)[:, None, None]
        doubled = np.sqrt((np.cross(unit[:, 0], unit[:, 1]) ** 2).sum(1))
        return np.asarray(~(doubled >= MIN_HEIGHT_SHARE))


def _measure_parts(
    corners: np.ndarray, faces: np.ndarray, part: np.ndarray, edges: _Edges, manifold: bool
) -> tuple[tuple[CheckedComponent, ...], float]:
    """Return the parts, largest first, and the total volume."""
    _, index, sizes = np.unique(part, return_inverse=True, return_counts=True)
    count = len(sizes)
    if count == 0:
        return (), 0.0
    with np.errstate(invalid="ignore", over="ignore"):
        # Tetrahedra over a corner of the mesh: a distant origin would lose digits.
        a, b, c = (corners[:, k] - corners[0, 0] for k in range(3))
        each = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    volumes = np.bincount(index, weights=each, minlength=count)
    edge_part = np.zeros(edges.count, np.int64)
    edge_part[edges.edge_index] = np.repeat(index, 3)
    _, first = np.unique(faces, return_index=True)
    vertex_count = np.bincount(index[first // 3], minlength=count)
    eulers = vertex_count - np.bincount(edge_part, minlength=count) + sizes
    order = np.argsort(-sizes, kind="stable")
    columns = (values[order].tolist() for values in (sizes, eulers, volumes))
    parts = tuple(
        CheckedComponent(size, euler, 1 - euler // 2 if manifold else None, inside)
        for size, euler, inside in zip(*columns, strict=True)
    )
    return parts, float(volumes.sum())
