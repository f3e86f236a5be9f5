# SPDX-License-Identifier: GPL-3.0-or-later
"""Open a closed mesh where its region cuts the solid, by removing the caps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ...errors import MeshingError
from ...mesh.components import compacted, without_floaters
from ...mesh.surface_mesh import SurfaceMesh
from ...mesh.topology import edge_keys, half_edges, next_half_edges, normals_and_areas
from ...regions.cap_planes import ON_PLANE_SHARE, cap_planes
from ...regions.convex_region import Region
from .repair import SEPARATION_SHARE

MOVED_SHARE = 1.5 * SEPARATION_SHARE
"""A vertex moved by the repair may be off its plane by this share of its face's longest edge."""

ALONG_COSINE = 0.9
"""A face with such a vertex belongs to a cap only if its normal agrees with the plane's: least
cosine."""


def without_caps(
    mesh: SurfaceMesh, region: Region, min_component_share: float = 0.0
) -> SurfaceMesh:
    """Remove the caps: the faces that close a mesh at the region's boundary.

    The result is consistently oriented and manifold, with boundary edges on the region's planes
    alone. A solid may fall into pieces; small ones are removed like floaters. ``provenance`` counts
    the removed faces, the removed pieces and the remaining parts.

    Parameters
    ----------
    mesh : SurfaceMesh
        Closed 2-manifold, made in ``region``.
    region : Region
        Same frame.
    min_component_share : float
        As for :func:`~...mesh.components.without_floaters`; 0 keeps every piece.

    Raises
    ------
    MeshingError
        No faces remain: the region lies within a solid.
    """
    vertices, faces = mesh.vertices.copy(), np.asarray(mesh.faces, np.int64)
    on_cap = np.zeros(len(faces), np.bool_)
    tolerance = ON_PLANE_SHARE * region.diagonal
    on_any = (cap_planes(vertices, region).planes >= 0).any(1)  # (v,)
    for normal, offset in zip(*region.half_spaces, strict=True):
        distance = (vertices - region.center) @ normal - offset  # (v,)
        cap = _cap_faces(vertices, faces, normal, distance, on_any, tolerance)
        # Rim vertices moved by the repair are projected back onto the plane. Those on another plane
        # stay there: between the planes of a round region they would leave it.
        rim = np.unique(faces[cap])
        rim = rim[~on_any[rim]]
        vertices[rim] -= distance[rim, None] * normal
        vertices[rim] = _within(vertices[rim], region)
        on_cap |= cap
    stays = faces[~on_cap]
    if len(stays) == 0:
        raise MeshingError(
            f"Region {region.name!r} lies within a solid: with an open boundary nothing is left.",
            "Draw the region around a surface, or keep the boundary closed.",
        )
    split, source = split_fans(stays)
    pieces = without_floaters(vertices[source], split, min_component_share)
    vertices, split, used = compacted(vertices[source], pieces.faces)
    colors = None if mesh.colors is None else mesh.colors[source[used]]
    rim = (cap_planes(vertices, region).planes >= 0).any(1)
    counted = {
        "boundary": "open",
        "cap_faces_left_out": int(on_cap.sum()),
        "components": pieces.kept,
        "removed_open_pieces": pieces.removed,
        "removed_open_area_share": pieces.removed_area_share,
        "vertices_on_region_boundary": int(rim.sum()),
    }
    return replace(
        mesh,
        vertices=vertices,
        faces=split.astype(np.int32),
        colors=colors,
        provenance={**mesh.provenance, **counted},
    )


def _within(points: np.ndarray, region: Region) -> np.ndarray:
    """Project points (n, 3) just outside a region onto the plane that they crossed."""
    normals, offsets = region.half_spaces
    points = points.copy()
    for _ in range(len(normals)):
        beyond = (points - region.center) @ normals.T - offsets  # (n, k)
        worst = beyond.argmax(1)
        out = beyond[np.arange(len(points)), worst]
        left = out > ON_PLANE_SHARE * region.diagonal
        if not left.any():
            break
        points[left] -= out[left, None] * normals[worst[left]]
    return points


def _cap_faces(
    vertices: np.ndarray,
    faces: np.ndarray,
    normal: np.ndarray,
    distance: np.ndarray,
    on_any: np.ndarray,
    tolerance: float,
) -> np.ndarray:
    """Return which faces lie on one plane of the region, (f,) bool.

    A face with a corner moved by the repair counts, unless other corners lie on other planes.
    """
    exact = np.abs(distance) <= tolerance  # (v,)
    cap = exact[faces].all(1)
    own = (exact | ~on_any)[faces].all(1)
    near = np.flatnonzero(exact[faces].any(1) & ~cap & own)
    corners = vertices[faces[near]]  # (k, 3, 3)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    unit, _ = normals_and_areas(vertices, faces[near])
    close = np.abs(distance[faces[near]]).max(1) <= MOVED_SHARE * longest
    cap[near[close & (unit @ normal >= ALONG_COSINE)]] = True
    return cap


def split_fans(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split vertices so that each fan of faces has its own; edges may have one or two faces.

    Returns
    -------
    faces : (f, 3) int64
        With new vertex numbers.
    source : (w,) int64
        Old vertex of each new one.
    """
    begin, end = half_edges(faces)
    keys = edge_keys(begin, end, int(faces.max()) + 1)
    order = np.argsort(keys, kind="stable")
    same = keys[order[1:]] == keys[order[:-1]]
    first, second = order[:-1][same], order[1:][same]  # half-edges of one edge, opposite ways
    half = np.arange(faces.size)
    following = next_half_edges(half)
    rows = np.concatenate([first, following[first]])
    columns = np.concatenate([following[second], second])
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(faces.size,) * 2)
    _, label = connected_components(graph, directed=False)
    _, first_corner, number = np.unique(label, return_index=True, return_inverse=True)
    return number.reshape(-1, 3), faces.reshape(-1)[first_corner]
