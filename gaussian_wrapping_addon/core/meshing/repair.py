# SPDX-License-Identifier: GPL-3.0-or-later
"""Manifold meshes without degenerate faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import MeshingError
from ..mesh.components import connected
from ..mesh.surface_mesh import (
    edge_lengths,
    faces_per_edge,
    half_edges,
    next_half_edges,
    normals_and_areas,
)
from ..regions.scene_regions import ON_PLANE_SHARE
from ..regions.shapes import Region

# -- Remove degenerate faces from a closed manifold by edge flips and collapses -------------------

MAX_PASSES = 14

SHORT_HEIGHTS = 2.0  # edges shorter than this many heights are collapsed

PATIENT_PASSES = 5
MAX_SHORT_HEIGHTS = 64.0
"""After these passes the length doubles each time, up to this: among several adjacent flat faces,
flips can cycle."""


def narrow_faces(vertices: np.ndarray, faces: np.ndarray, height: float) -> np.ndarray:
    """Return indices of the faces whose smallest height is below ``height``."""
    _, areas = normals_and_areas(vertices, faces)
    longest = edge_lengths(vertices, faces).max(1)
    return np.flatnonzero(2 * areas < height * np.maximum(longest, 1e-300))


def remove_degenerate(
    vertices: np.ndarray,
    faces: np.ndarray,
    height: float,
    region: Region | None = None,
    fixed: np.ndarray | None = None,
) -> tuple[np.ndarray, int]:
    """Remove faces narrower than ``height``: needles by edge collapses, flat ones by edge flips.

    Every step keeps a closed 2-manifold closed and manifold; faces that no step can remove
    stay. Vertices are not moved, so the surface changes by about ``height``.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int64
        A closed 2-manifold.
    region : Region, optional
        Keeps caps on the region's planes: no vertex is merged into one that lies on fewer of these
        planes, and no edge of the region is flipped unless the third vertex lies on it as well.
    fixed : (v,) bool, optional
        For a part of a mesh: vertices that have faces elsewhere.

    Returns
    -------
    faces : (g, 3) int64
        Over the same vertices, some of which may be unused.
    left : int
        Degenerate faces that remain.
    """
    narrow = narrow_faces(vertices, faces, height)
    planes = _plane_sets(vertices, faces, narrow, region)
    for done in range(MAX_PASSES):
        if len(narrow) == 0:
            break
        longer = 2.0 ** max(0, done - PATIENT_PASSES)
        short = height * min(SHORT_HEIGHTS * longer, MAX_SHORT_HEIGHTS)
        near, frozen = _surroundings(len(vertices), faces, narrow)
        if fixed is not None:
            corners = np.unique(faces[near])
            frozen |= set(corners[fixed[corners]].tolist())
        mesh = _HalfEdgeMesh(faces[near], frozen)
        changed = False
        for face in np.searchsorted(near, narrow).tolist():
            if mesh.faces[face] is not None:
                changed |= _remove_face(mesh, vertices, face, short, planes)
        if not changed:
            if short >= height * MAX_SHORT_HEIGHTS:
                break
            continue
        gone = np.array([f is None for f in mesh.faces])
        faces = faces.copy()
        faces[near[~gone]] = np.array([f for f in mesh.faces if f is not None]).reshape(-1, 3)
        faces = np.delete(faces, near[gone], 0)
        narrow = narrow_faces(vertices, faces, height)
        planes = _plane_sets(vertices, faces, narrow, region)
    return faces, len(narrow)


_NO_PLANES: frozenset[int] = frozenset()


def _plane_sets(
    vertices: np.ndarray, faces: np.ndarray, narrow: np.ndarray, region: Region | None
) -> dict[int, frozenset[int]]:
    """Map corners of narrow faces to the region's planes that they lie on, if any."""
    if region is None or len(narrow) == 0:
        return {}
    corners = np.unique(faces[narrow])
    local = vertices[corners] - region.center
    found: dict[int, set[int]] = {}
    for number, (normal, offset) in enumerate(zip(*region.half_spaces, strict=True)):
        on_it = np.abs(local @ normal - offset) <= ON_PLANE_SHARE * region.diagonal
        for corner in corners[on_it].tolist():
            found.setdefault(corner, set()).add(number)
    return {corner: frozenset(numbers) for corner, numbers in found.items()}


def _surroundings(count: int, faces: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, set[int]]:
    """Return increasing indices of the faces within two rings of the chosen ones.

    A step visits the faces around the corners of a narrow face and of its neighbours; editable
    lists of the whole mesh would take ten times its memory. Also returns the vertices that have
    faces beyond: steps that would need those wait for the next pass.
    """
    for _ in range(2):
        touched = np.zeros(count, np.bool_)
        touched[faces[chosen]] = True
        chosen = np.flatnonzero(touched[faces].any(1))
    beyond = np.zeros(count, np.bool_)
    beyond[np.delete(faces, chosen, 0)] = True
    here = np.unique(faces[chosen])
    return chosen, set(here[beyond[here]].tolist())


class _HalfEdgeMesh:
    """Editable half-edge structure for local changes."""

    def __init__(self, faces: np.ndarray, frozen: set[int]) -> None:
        self.frozen = frozen
        self.faces: list[tuple[int, int, int] | None] = [tuple(f) for f in faces.tolist()]
        self.left_of: dict[tuple[int, int], int] = {}
        self.around: dict[int, set[int]] = {}
        for index in range(len(self.faces)):
            self._link(index)

    def at(self, index: int) -> tuple[int, int, int]:
        """Return a face that is there."""
        face = self.faces[index]
        assert face is not None
        return face

    def _link(self, index: int) -> None:
        a, b, c = self.at(index)
        for begin, end in ((a, b), (b, c), (c, a)):
            self.left_of[begin, end] = index
            self.around.setdefault(begin, set()).add(index)

    def _unlink(self, index: int) -> None:
        a, b, c = self.at(index)
        for begin, end in ((a, b), (b, c), (c, a)):
            if self.left_of.get((begin, end)) == index:
                del self.left_of[begin, end]
            self.around[begin].discard(index)

    def ring(self, vertex: int) -> set[int]:
        return {v for index in self.around[vertex] for v in self.at(index)} - {vertex}

    def replace(self, old: list[int], new: list[tuple[int, int, int] | None]) -> None:
        for index in old:
            self._unlink(index)
        for index, face in zip(old, new, strict=True):
            self.faces[index] = face
            if face is not None:
                self._link(index)

    def flip(self, begin: int, end: int) -> bool:
        """Exchange the diagonal ``begin``-``end`` for the other one of its quad."""
        if begin in self.frozen and end in self.frozen:
            return False
        first, second = self.left_of[begin, end], self.left_of[end, begin]
        p, q = self.apex(first, begin, end), self.apex(second, begin, end)
        if p == q or q in self.ring(p) or (p in self.frozen and q in self.frozen):
            return False
        self.replace([first, second], [(p, q, end), (q, p, begin)])
        return True

    def collapse(self, gone: int, stays: int) -> bool:
        """Merge ``gone`` into ``stays`` where the link condition allows it."""
        if gone in self.frozen or stays in self.frozen:
            return False
        here, there = self.ring(gone), self.ring(stays)
        if len(here & there) != 2 or len(here) + len(there) <= 6:
            return False
        old = sorted(self.around[gone])
        new: list[tuple[int, int, int] | None] = []
        for index in old:
            a, b, c = (stays if v == gone else v for v in self.at(index))
            new.append(None if a == b or b == c or c == a else (a, b, c))
        self.replace(old, new)
        return True

    def apex(self, index: int, begin: int, end: int) -> int:
        return next(v for v in self.at(index) if v not in (begin, end))


def _remove_face(
    mesh: _HalfEdgeMesh, vertices: np.ndarray, face: int, short: float,
    planes: dict[int, frozenset[int]],
) -> bool:  # fmt: skip
    corners = mesh.at(face)
    ends = [(corners[k], corners[(k + 1) % 3]) for k in range(3)]
    lengths = [float(np.linalg.norm(vertices[a] - vertices[b])) for a, b in ends]
    shortest, longest = int(np.argmin(lengths)), int(np.argmax(lengths))

    def merged(gone: int, stays: int) -> bool:
        of_gone, of_stays = planes.get(gone, _NO_PLANES), planes.get(stays, _NO_PLANES)
        return of_gone <= of_stays and mesh.collapse(gone, stays)

    if lengths[shortest] < short:
        a, b = ends[shortest]
        if merged(a, b) or merged(b, a):
            return True
        # The ends have a third neighbour in common. Often that is a tip whose three faces form a
        # fin without volume, since its base is as short as this edge.
        for tip in corners:
            is_tip = len(mesh.around[tip]) == 3 and tip not in mesh.frozen
            if is_tip and any(merged(tip, v) for v in sorted(mesh.ring(tip))):
                return True
    a, b = ends[longest]
    third = corners[(longest + 2) % 3]
    shared = planes.get(a, _NO_PLANES) & planes.get(b, _NO_PLANES)
    # Three points on an edge of the region: the other two sides run along it instead.
    along = shared <= planes.get(third, _NO_PLANES)
    return (len(shared) < 2 or along) and mesh.flip(a, b)


# -- Turn closed triangle sets into 2-manifolds by splitting non-manifold edges and vertices ------

SEPARATION_SHARE = 0.005
"""Copies of a vertex move this share of the way to the centroid of their own faces, so that the
parts do not touch and programs that merge equal points do not join them again. With four times as
much, coarse meshes of thin structures left the isosurface: 99 % of a room's vertices were within
0.05 of the level, not within 0.02."""

MAX_REPAIR_PASSES = 20

_DEFECT = "Send the job folder's log.txt with a bug report."


@dataclass(frozen=True)
class RepairResult:
    """A closed 2-manifold."""

    vertices: np.ndarray  # (v, 3) float64
    faces: np.ndarray  # (f, 3) int64
    origin: np.ndarray  # (v,) int64: the original vertex, or -1 for midpoints of split edges
    split_vertices: int  # copies that were added
    split_edges: int  # edges that were split at their midpoint


def split_nonmanifold(
    vertices: np.ndarray, faces: np.ndarray, fixed: np.ndarray | None = None
) -> RepairResult:
    """Split edges with more than two faces, and vertices with more than one fan of faces.

    Around an edge, faces that bound the same wedge of the solid stay together. Where both copies
    of such an edge would still join the same two vertices, each is split at its midpoint. No face
    is removed, so the enclosed solid is kept.

    ``faces`` (f, 3) are closed and consistently oriented: along each edge as many half-edges run
    one way as the other. ``fixed`` (v,) bool, for a part of a closed set of faces, are vertices
    that are not split, nor the edges between them; all faces at the others are given.
    Raises MeshingError: the set of faces is not closed.
    """
    faces = np.asarray(faces, np.int64)
    fixed = np.zeros(len(vertices), np.bool_) if fixed is None else fixed
    origin = np.arange(len(vertices))
    split_edges = 0
    if len(faces) == 0:
        return RepairResult(vertices[:0], faces, origin[:0], 0, 0)
    before = len(np.unique(faces))
    for _ in range(MAX_REPAIR_PASSES):
        partner = _partners(vertices, faces, fixed)
        new_faces, source = _fans(faces, partner, fixed)
        vertices, origin, fixed = vertices[source], origin[source], fixed[source]
        bad = (faces_per_edge(new_faces, int(new_faces.max()) + 1) > 2) & (partner >= 0)
        if not bad.any():
            break
        pairs = _independent_pairs(bad, partner)
        begin, end = half_edges(new_faces)
        middles = (vertices[begin[pairs]] + vertices[end[pairs]]) / 2
        faces = _split_at_middles(new_faces, pairs, partner, len(vertices))
        vertices = np.concatenate([vertices, middles])
        origin = np.append(origin, np.full(len(pairs), -1))
        fixed = np.append(fixed, np.zeros(len(pairs), np.bool_))
        split_edges += len(pairs)
    else:
        raise MeshingError("The surface could not be made manifold.", _DEFECT)
    moved = _separate_copies(vertices, new_faces, origin)
    return RepairResult(moved, new_faces, origin, len(moved) - before - split_edges, split_edges)


def _partners(vertices: np.ndarray, faces: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """Pair each half-edge with the opposite one that bounds the same wedge of the solid.

    -1 for half-edges between fixed vertices.
    """
    begin, end = half_edges(faces)
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    forward = begin < end
    order = np.lexsort((forward, high, low))
    order = order[~(fixed[low] & fixed[high])[order]]
    if len(order) == 0:
        return np.full(faces.size, -1)
    new_edge = np.ones(len(order), np.bool_)
    new_edge[1:] = (low[order[1:]] != low[order[:-1]]) | (high[order[1:]] != high[order[:-1]])
    starts = np.append(np.flatnonzero(new_edge), len(order))
    sizes = np.diff(starts)
    forwards = np.add.reduceat(forward[order].astype(np.int64), starts[:-1])
    if (2 * forwards != sizes).any():
        raise MeshingError("The surface is not closed.", _DEFECT)
    partner = np.full(faces.size, -1)
    plain = starts[:-1][sizes == 2]
    partner[order[plain]], partner[order[plain + 1]] = order[plain + 1], order[plain]
    for index in np.flatnonzero(sizes > 2):
        group = order[starts[index] : starts[index + 1]]
        for first, second in _wedges(vertices, faces, group, forward[group]):
            partner[first], partner[second] = second, first
    return partner


def _wedges(
    vertices: np.ndarray, faces: np.ndarray, group: np.ndarray, forward: np.ndarray
) -> list[tuple[int, int]]:
    """Pair the half-edges around one edge by the wedges of the solid, sorted by angle."""
    face, corner = np.divmod(group, 3)
    low, high = sorted((faces[face[0], corner[0]], faces[face[0], (corner[0] + 1) % 3]))
    opposite = faces[face, (corner + 2) % 3]  # (k,)
    axis = vertices[high] - vertices[low]
    axis = axis / max(float(np.linalg.norm(axis)), 1e-300)
    arms = vertices[opposite] - vertices[low]
    arms = arms - (arms @ axis)[:, None] * axis  # (k, 3)
    first = arms[0] / max(float(np.linalg.norm(arms[0])), 1e-300)
    angle = np.arctan2(arms @ np.cross(axis, first), arms @ first) % (2 * np.pi)
    order = np.argsort(angle, kind="stable")
    # Seen along the axis (low -> high), a forward face has the solid on the clockwise side of its
    # arm, so a wedge begins at a backward face and ends at a forward one: pair each backward face
    # with the next forward one, like brackets, cyclically.
    pairs: list[tuple[int, int]] = []
    waiting: list[int] = []
    for slot in [*order, *order]:
        if len(pairs) * 2 == len(group):
            break
        if any(group[slot] in pair for pair in pairs):
            continue
        if not forward[slot]:
            if slot not in waiting:
                waiting.append(slot)
        elif waiting:
            pairs.append((int(group[waiting.pop()]), int(group[slot])))
    assert len(pairs) * 2 == len(group)
    return pairs


def _fans(
    faces: np.ndarray, partner: np.ndarray, fixed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Split vertices that are not fixed so that each fan of faces has its own.

    Returns (f, 3) faces of new vertices, which are ordered by old vertex, and the old vertex of
    each new one, (w,).
    """
    vertex = faces.reshape(-1)
    # Half-edge h leads from corner h to the next; its partner runs the other way.
    here = np.flatnonzero(partner >= 0)
    there = partner[here]
    whole = np.flatnonzero(fixed[vertex])
    first = np.zeros(len(fixed), np.int64)
    first[vertex[whole]] = whole  # any one corner of each
    rows = np.concatenate([here, next_half_edges(here), whole])
    columns = np.concatenate([next_half_edges(there), there, first[vertex[whole]]])
    _, label = connected(rows, columns, faces.size)
    _, least = np.unique(label, return_index=True)
    old = vertex[least]
    order = np.lexsort((least, old))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return rank[label].reshape(-1, 3), old[order]


def _independent_pairs(bad: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """Choose pairs (by their first half-edge) so that no face is split twice in one pass."""
    chosen: list[int] = []
    busy: set[int] = set()
    for h in np.flatnonzero(bad).tolist():
        other = int(partner[h])
        if h < other and h // 3 not in busy and other // 3 not in busy:
            chosen.append(h)
            busy.update((h // 3, other // 3))
    return np.array(chosen, np.int64)


def _split_at_middles(
    faces: np.ndarray, pairs: np.ndarray, partner: np.ndarray, first_new: int
) -> np.ndarray:
    result, added = faces.copy(), []
    for number, h in enumerate(pairs.tolist()):
        middle = first_new + number
        for half in (h, int(partner[h])):
            face, k = divmod(half, 3)
            a, b, c = faces[face, k], faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
            result[face] = (a, middle, c)
            added.append((middle, b, c))
    return np.concatenate([result, np.array(added, np.int64).reshape(-1, 3)])


def _separate_copies(vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Move copies of vertices slightly towards their own faces."""
    copies = np.bincount(origin[origin >= 0], minlength=int(origin.max(initial=0)) + 1)
    moving = (origin < 0) | (copies[origin] > 1)
    if not moving.any():
        return vertices
    total, count = np.zeros_like(vertices), np.zeros(len(vertices))
    centers = vertices[faces].mean(1)  # (f, 3)
    for k in range(3):
        np.add.at(total, faces[:, k], centers)
        np.add.at(count, faces[:, k], 1.0)
    target = total / np.maximum(count, 1.0)[:, None]
    result = vertices.copy()
    result[moving] += SEPARATION_SHARE * (target - vertices)[moving]
    return result
