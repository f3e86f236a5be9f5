# SPDX-License-Identifier: GPL-3.0-or-later
"""Close handles below the mesh's resolution by replacing the patch around each by a disc."""

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
"""Sides of the boxes that are searched for handles, in edge lengths of the mesh, in increasing
order. Both loops of a handle, through it and around it, must lie in one box: a tube is no handle
there, nor is an opening wider than the box. A handle of half the last side is found wherever it
lies, a larger one only where a box happens to contain it."""

MAX_MOVE_EDGES = 2.25
"""Greatest distance, in edge lengths, of a removed vertex from the disc that replaces the patch,
half of the largest box: anything farther away is a structure of its own, not noise."""

MAX_LOOP_EDGES = 60
"""Patches with a longer boundary are skipped: the disc would not follow the surface."""

THIN = 1e-6
"""A triangle whose area is a smaller share of its squared side is degenerate: points on the
region's boundary can be collinear."""

MAX_PASSES = 8


@dataclass(frozen=True)
class HandleClosure:
    """Result of :func:`without_small_handles`."""

    faces: np.ndarray
    """(g, 3) int64."""
    closed: int
    """Handles that were closed."""
    left: int
    """Small handles that could not be closed without cutting something else; there may be more that
    no box happens to contain."""


@dataclass(frozen=True)
class _Patches:
    """Connected sets of faces in the same box."""

    of_face: np.ndarray
    """(f,) int64 label of each face."""
    handles: np.ndarray
    """(p,) int64 genus of each; 0 also where the boundary touches itself."""
    loops: np.ndarray
    """(p,) int64 boundary loops of each."""


def without_small_handles(
    vertices: np.ndarray, faces: np.ndarray, edge_length: float
) -> HandleClosure:
    """Replace patches with handles in small boxes by discs with the same boundary.

    Such handles are below the mesh's resolution: noise of the isosurface or of the labels of thin
    tetrahedra. Vertices are neither moved nor added. A patch with more than one boundary loop is
    kept, since discs would cut what passes through it.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
        Closed 2-manifold, consistently oriented.
    edge_length : float
        Edge length of the final mesh, scene units.
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
    """Return the total genus of a closed 2-manifold."""
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
    """Return the largest distance of points (n, 3) to the centroids and corners of (t, 3, 3)."""
    if len(points) == 0:
        return 0.0
    near = np.concatenate([triangles.mean(1), triangles.reshape(-1, 3)])
    return float(cKDTree(near).query(points)[0].max())


def _patches(vertices: np.ndarray, faces: np.ndarray, side: float, shift: np.ndarray) -> _Patches:
    """Group adjacent faces whose centroids lie in the same box; count handles and loops."""
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
    # Edges inside a patch and on its boundary; an edge between two patches belongs to both.
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
    # A patch without a boundary is a whole small part: its handles are small as well, but no disc
    # can replace it.
    handles = np.where(touching | (loops == 0), 0, (2 - euler - loops) // 2)
    return _Patches(label, handles, loops)


def _edge_keys(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the edge keys of all half-edges, (3f,) int64."""
    return edge_keys(*half_edges(faces), count)


def _boundary_loop(faces: np.ndarray) -> np.ndarray | None:
    """Return the boundary vertices of a patch in the order of its half-edges, (n,) int64."""
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
        Pairs that must not be joined, since the mesh has that edge elsewhere.

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
