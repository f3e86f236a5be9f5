# SPDX-License-Identifier: GPL-3.0-or-later
"""Faces without area, removed from a closed manifold by flips and collapses."""

from __future__ import annotations

import numpy as np

from .sampling import triangle_normals

MAX_PASSES = 12


def narrow_faces(vertices: np.ndarray, faces: np.ndarray, height: float) -> np.ndarray:
    """Return indices of the faces whose smallest height is below ``height``."""
    _, areas = triangle_normals(vertices, faces)
    longest = edge_lengths(vertices, faces).max(1)
    return np.flatnonzero(2 * areas < height * np.maximum(longest, 1e-300))


def edge_lengths(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (f, 3) lengths; edge k leads from corner k to the next."""
    corners = vertices[faces]  # (f, 3, 3)
    return np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2)


def remove_degenerate(
    vertices: np.ndarray, faces: np.ndarray, height: float
) -> tuple[np.ndarray, int]:
    """Remove faces narrower than ``height``: needles by collapse, flat ones by flipping.

    Every step keeps a closed 2-manifold closed and manifold; a face that no step can remove
    stays. Vertices are not moved, so the surface changes by at most ``height``.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int64
        A closed 2-manifold.

    Returns
    -------
    faces : (g, 3) int64
        Over the same vertices, some of which may be unused.
    left : int
        Degenerate faces that stay.
    """
    narrow = narrow_faces(vertices, faces, height)
    for _ in range(MAX_PASSES):
        if len(narrow) == 0:
            break
        mesh = _Editable(faces)
        changed = False
        for face in narrow.tolist():
            if mesh.faces[face] is not None:
                changed |= _improve(mesh, vertices, face, height)
        if not changed:
            break
        faces = np.array([f for f in mesh.faces if f is not None], np.int64).reshape(-1, 3)
        narrow = narrow_faces(vertices, faces, height)
    return faces, len(narrow)


class _Editable:
    """Faces by half-edge, for a few local changes."""

    def __init__(self, faces: np.ndarray) -> None:
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
        first, second = self.left_of[begin, end], self.left_of[end, begin]
        p, q = self.apex(first, begin, end), self.apex(second, begin, end)
        if p == q or q in self.ring(p):
            return False
        self.replace([first, second], [(p, q, end), (q, p, begin)])
        return True

    def collapse(self, gone: int, stays: int) -> bool:
        """Merge ``gone`` into ``stays`` where the link condition allows it."""
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


def _improve(mesh: _Editable, vertices: np.ndarray, face: int, height: float) -> bool:
    corners = mesh.faces[face]
    assert corners is not None
    lengths = [
        float(np.linalg.norm(vertices[corners[k]] - vertices[corners[(k + 1) % 3]]))
        for k in range(3)
    ]
    shortest, longest = int(np.argmin(lengths)), int(np.argmax(lengths))
    if lengths[shortest] < 2.0 * height:
        a, b = corners[shortest], corners[(shortest + 1) % 3]
        return mesh.collapse(a, b) or mesh.collapse(b, a)
    return mesh.flip(corners[longest], corners[(longest + 1) % 3])
