# SPDX-License-Identifier: GPL-3.0-or-later
"""Handles smaller than the mesh resolves are closed: the patch around each becomes a disc."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ...mesh.components import face_components
from ...mesh.topology import edge_keys, half_edges

BOX_EDGES = (2.0, 3.0, 4.5)
"""Sides of the boxes in which handles are looked for, in edge lengths of the mesh, small ones
first. Both loops of a handle, through it and around it, have to lie in one box: a tube is no handle
there, nor is an opening that is wider than the box. A handle of half of the last side is found
wherever it lies, a larger one where a box happens to hold it."""

MAX_MOVE_EDGES = 2.25
"""A vertex that goes lies at most so many edge lengths from the disc that takes the patch's place,
half of the largest box: more is a thing of its own, not noise of the surface."""

MAX_LOOP_EDGES = 60
"""A patch with more edges around it is left alone: its cover would not follow the surface."""

THIN = 1e-6
"""A triangle whose area is a smaller share of the square of its side is a line: on the region's
boundary points lie on lines."""

MAX_PASSES = 8


@dataclass(frozen=True)
class HandleClosure:
    """What :func:`without_small_handles` did."""

    faces: np.ndarray
    """(g, 3) int64."""
    closed: int
    """Handles that are gone."""
    left: int
    """Small handles that could not be closed without cutting something else; there may be more that
    no box happens to hold."""


@dataclass(frozen=True)
class _Patches:
    """Connected sets of faces with the same box."""

    of_face: np.ndarray
    """(f,) int64 label of each face."""
    handles: np.ndarray
    """(p,) int64 genus of each; 0 too where the outline touches itself."""
    loops: np.ndarray
    """(p,) int64 closed curves around each."""


def without_small_handles(
    vertices: np.ndarray, faces: np.ndarray, edge_length: float
) -> HandleClosure:
    """Replace patches with handles in small boxes by discs with the same outline.

    A handle that small is below what the mesh resolves: noise of the isosurface, or of the labels
    of thin tetrahedra. Vertices do not move, new ones are not made. A patch with more than one
    outline stays, since a disc on each would cut what runs through it.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
        Closed 2-manifold, consistently oriented.
    edge_length : float
        Of the mesh that is wanted, scene units.
    """
    faces = np.asarray(faces, np.int64)
    if _genus(len(vertices), faces) == 0:
        return HandleClosure(faces, 0, 0)
    closed = 0
    for share in BOX_EDGES:
        for _ in range(MAX_PASSES):
            found = 0
            for shift in product((0.0, 0.5), repeat=3):
                faces, count = _close_in_grid(vertices, faces, share, edge_length, np.array(shift))
                found += count
            closed += found
            if found == 0:
                break
    left = 0
    for shift in product((0.0, 0.5), repeat=3):
        patches = _patches(vertices, faces, BOX_EDGES[-1] * edge_length, np.array(shift))
        left = max(left, int(patches.handles.sum()))
    return HandleClosure(faces, closed, left)


def _genus(vertex_count: int, faces: np.ndarray) -> int:
    """Return the genus of all parts of a closed 2-manifold together."""
    parts, _ = face_components(vertex_count, faces)
    euler = len(np.unique(faces)) - len(faces) // 2
    return (2 * parts - euler) // 2


def _close_in_grid(
    vertices: np.ndarray, faces: np.ndarray, share: float, edge_length: float, shift: np.ndarray
) -> tuple[np.ndarray, int]:
    """Close the handles in the boxes of one grid; return the faces and the number of handles."""
    patches = _patches(vertices, faces, share * edge_length, shift)
    chosen = np.flatnonzero((patches.handles > 0) & (patches.loops == 1))
    if len(chosen) == 0:
        return faces, 0
    count = len(vertices)
    keys = np.sort(_edge_keys(faces, count))
    order = np.argsort(patches.of_face, kind="stable")
    bounds = np.searchsorted(patches.of_face[order], np.stack([chosen, chosen + 1], axis=1))
    kept = np.ones(len(faces), np.bool_)
    covers: list[np.ndarray] = []
    covered: set[int] = set()
    closed = 0
    for label, (first, last) in zip(chosen.tolist(), bounds.tolist(), strict=True):
        rows = order[first:last]
        loop = _boundary_loop(faces[rows])
        if loop is None or len(loop) > MAX_LOOP_EDGES:
            continue
        pairs = edge_keys(loop[:, None], loop[None, :], count)  # (n, n)
        forbidden = keys[np.minimum(np.searchsorted(keys, pairs), len(keys) - 1)] == pairs
        forbidden &= ~np.isin(pairs, _edge_keys(faces[rows], count))
        forbidden |= np.array([key in covered for key in pairs.ravel().tolist()]).reshape(
            pairs.shape
        )
        cover = _least_area_triangles(vertices[loop], loop, forbidden)
        if cover is None:
            continue
        gone = np.setdiff1d(faces[rows], loop)
        if _farthest(vertices[gone], vertices[cover]) > MAX_MOVE_EDGES * edge_length:
            continue
        kept[rows] = False
        covers.append(cover)
        covered.update(_edge_keys(cover, count).tolist())
        closed += int(patches.handles[label])
    return np.concatenate([faces[kept], *covers]), closed


def _farthest(points: np.ndarray, triangles: np.ndarray) -> float:
    """Return the largest distance of points (n, 3) to the middles and corners of (t, 3, 3)."""
    if len(points) == 0:
        return 0.0
    near = np.concatenate([triangles.mean(1), triangles.reshape(-1, 3)])
    return float(cKDTree(near).query(points)[0].max())


def _patches(vertices: np.ndarray, faces: np.ndarray, side: float, shift: np.ndarray) -> _Patches:
    """Group neighbouring faces whose middles lie in the same box; count handles and outlines."""
    middle = vertices[faces].mean(1)
    box = np.floor((middle - middle.min(0)) / side + shift).astype(np.int64)  # (f, 3)
    size = box.max(0) + 1
    box_id = (box[:, 0] * size[1] + box[:, 1]) * size[2] + box[:, 2]
    count = len(vertices)
    begin, end = half_edges(faces)
    order = np.argsort(edge_keys(begin, end, count), kind="stable")
    # A closed 2-manifold: edges come in pairs.
    one, two = order[0::2] // 3, order[1::2] // 3  # (e,) faces beside each edge
    same = box_id[one] == box_id[two]
    graph = coo_matrix((np.ones(same.sum(), np.int8), (one[same], two[same])), (len(faces),) * 2)
    number, label = connected_components(graph, directed=False)
    label = label.astype(np.int64)
    # Edges within a patch and on its outline; an edge between two patches is on both.
    low, high = begin[order[0::2]], end[order[0::2]]
    between = label[one] != label[two]
    outline_patch = np.concatenate([label[one[between]], label[two[between]]])
    outline_low = np.tile(low[between], 2)
    outline_high = np.tile(high[between], 2)
    edge_count = np.bincount(label[one], minlength=number) + np.bincount(
        label[two[between]], minlength=number
    )
    corner = np.unique(np.repeat(label, 3) * count + begin)
    vertex_count = np.bincount(corner // count, minlength=number)
    face_count = np.bincount(label, minlength=number)
    euler = vertex_count - edge_count + face_count
    ends = np.concatenate(
        [outline_patch * count + outline_low, outline_patch * count + outline_high]
    )
    nodes, index, degree = np.unique(ends, return_inverse=True, return_counts=True)
    half = len(outline_patch)
    loop_graph = coo_matrix(
        (np.ones(half, np.int8), (index[:half], index[half:])), (len(nodes),) * 2
    )
    loop_count, loop_label = connected_components(loop_graph, directed=False)
    loop_patch = np.zeros(loop_count, np.int64)
    loop_patch[loop_label] = nodes // count
    loops = np.bincount(loop_patch, minlength=number)
    touching = np.bincount(nodes[degree != 2] // count, minlength=number) > 0
    # A patch without an outline is a whole small part: its handles are small too, but it has no
    # disc to become.
    handles = np.where(touching | (loops == 0), 0, (2 - euler - loops) // 2)
    return _Patches(label, handles, loops)


def _edge_keys(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the numbers of all half-edges, (3f,) int64."""
    return edge_keys(*half_edges(faces), count)


def _boundary_loop(faces: np.ndarray) -> np.ndarray | None:
    """Return the vertices around a patch in the order of its half-edges, (n,) int64."""
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()
    pairs = {(a, b) for a, b in half}
    following = {a: b for a, b in half if (b, a) not in pairs}
    start = next(iter(following))
    loop = [start]
    while (after := following[loop[-1]]) != start:
        loop.append(after)
        if len(loop) > len(following):
            return None
    return np.array(loop, np.int64) if len(loop) == len(following) else None


def _least_area_triangles(
    points: np.ndarray, loop: np.ndarray, forbidden: np.ndarray
) -> np.ndarray | None:
    """Return the triangles of least area that span a loop, (n - 2, 3), or None.

    Parameters
    ----------
    points : (n, 3) float64
    taken : (n, n) bool
        Pairs that may not be joined, since the mesh has that edge elsewhere.

    Notes
    -----
    Dynamic programming over the loop's sub-polygons, O(n^3).
    """
    count = len(loop)
    cost = np.full((count, count), np.inf)
    split = np.full((count, count), -1, np.int64)
    cost[np.arange(count - 1), np.arange(1, count)] = 0.0
    for gap in range(2, count):
        for i in range(count - gap):
            j = i + gap
            if gap < count - 1 and forbidden[i, j]:
                continue
            middle = np.arange(i + 1, j)
            arms = np.cross(points[middle] - points[i], points[j] - points[i])
            areas = np.linalg.norm(arms, axis=1)
            thin = areas <= THIN * ((points[middle] - points[i]) ** 2).sum(1)
            total = cost[i, middle] + cost[middle, j] + np.where(thin, np.inf, areas)
            best = int(np.argmin(total))
            cost[i, j], split[i, j] = total[best], middle[best]
    if not np.isfinite(cost[0, count - 1]):
        return None
    triangles, waiting = [], [(0, count - 1)]
    while waiting:
        i, j = waiting.pop()
        if j - i >= 2:
            k = int(split[i, j])
            triangles.append((i, k, j))
            waiting += [(i, k), (k, j)]
    return loop[np.array(triangles, np.int64)]
