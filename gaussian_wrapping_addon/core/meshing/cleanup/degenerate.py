# SPDX-License-Identifier: GPL-3.0-or-later
"""Remove degenerate faces from a closed manifold by edge flips and collapses."""

from __future__ import annotations

import numpy as np

from ...mesh.topology import edge_lengths, normals_and_areas
from ...regions.cap_planes import ON_PLANE_SHARE
from ...regions.convex_region import Region

MAX_PASSES = 14

SHORT_HEIGHTS = 2.0
"""Edges shorter than this many heights are collapsed."""

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

    def _link(self, index: int) -> None:
        face = self.faces[index]
        assert face is not None
        for k in range(3):
            self.left_of[face[k], face[(k + 1) % 3]] = index
            self.around.setdefault(face[k], set()).add(index)

    def _unlink(self, index: int) -> None:
        face = self.faces[index]
        assert face is not None
        for k in range(3):
            if self.left_of.get((face[k], face[(k + 1) % 3])) == index:
                del self.left_of[face[k], face[(k + 1) % 3]]
            self.around[face[k]].discard(index)

    def ring(self, vertex: int) -> set[int]:
        ring: set[int] = set()
        for index in self.around[vertex]:
            ring.update(self.faces[index] or ())
        ring.discard(vertex)
        return ring

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
        common = self.ring(gone) & self.ring(stays)
        if len(common) != 2 or len(self.ring(gone)) + len(self.ring(stays)) <= 6:
            return False
        old = sorted(self.around[gone])
        new: list[tuple[int, int, int] | None] = []
        for index in old:
            face = self.faces[index]
            assert face is not None
            a, b, c = (stays if v == gone else v for v in face)
            new.append(None if a == b or b == c or c == a else (a, b, c))
        self.replace(old, new)
        return True

    def apex(self, index: int, begin: int, end: int) -> int:
        face = self.faces[index]
        assert face is not None
        return next(v for v in face if v not in (begin, end))


def _remove_face(
    mesh: _HalfEdgeMesh,
    vertices: np.ndarray,
    face: int,
    short: float,
    planes: dict[int, frozenset[int]],
) -> bool:
    corners = mesh.faces[face]
    assert corners is not None
    lengths = [
        float(np.linalg.norm(vertices[corners[k]] - vertices[corners[(k + 1) % 3]]))
        for k in range(3)
    ]
    shortest, longest = int(np.argmin(lengths)), int(np.argmax(lengths))

    def merged(gone: int, stays: int) -> bool:
        of_gone, of_stays = planes.get(gone, _NO_PLANES), planes.get(stays, _NO_PLANES)
        return of_gone <= of_stays and mesh.collapse(gone, stays)

    if lengths[shortest] < short:
        a, b = corners[shortest], corners[(shortest + 1) % 3]
        if merged(a, b) or merged(b, a):
            return True
        # The ends have a third neighbour in common. Often that is a tip whose three faces form a
        # fin without volume, since its base is as short as this edge.
        for tip in corners:
            if (
                len(mesh.around[tip]) == 3
                and tip not in mesh.frozen
                and any(merged(tip, v) for v in sorted(mesh.ring(tip)))
            ):
                return True
    a, b = corners[longest], corners[(longest + 1) % 3]
    third = corners[(longest + 2) % 3]
    shared = planes.get(a, _NO_PLANES) & planes.get(b, _NO_PLANES)
    # Three points on an edge of the region: the other two sides run along it instead.
    along = shared <= planes.get(third, _NO_PLANES)
    return (len(shared) < 2 or along) and mesh.flip(a, b)
