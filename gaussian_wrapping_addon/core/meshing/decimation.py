# SPDX-License-Identifier: GPL-3.0-or-later
"""Fewer faces at the least error, by edge collapses that keep a closed manifold what it is.

Quadric errors order the collapses. Libraries that do the same break thin parts (their collapses
join sheets) or fold faces over: ``benchmarks/meshing_parts/decimation.py`` measures both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..errors import MeshingError
from ..progress import Progress
from . import decimation_kernels as kernels
from .cap_planes import CapPlanes, cap_planes
from .components import compacted
from .convex_region import Region

MIN_TARGET = 4
"""Faces of a tetrahedron: no closed surface has fewer."""

LOOKS_PER_CALL = 100_000
"""Edges looked at between two moments at which the work can be cancelled: about 0.2 s."""


class Limits(NamedTuple):
    """What a collapse may do to the faces around it."""

    turn_cos: float
    """Cosine of the largest turn of a face in one collapse."""
    fold_cos: float
    """Cosine of the sharpest bend between neighbours that may come up: -1 is folded back flat."""
    min_shape: float
    """Least height of a new face over its longest edge, unless the face was narrower before."""


LIMITS = Limits(0.0, -0.97, 1e-4)
"""Bends up to 166 degrees, and no face ever turns over (90 degrees). Tighter bounds were measured
and are worse: they make collapses go where they cost more. Needles are allowed, for wires and
plates need long narrow faces; the bound still lies far above what counts as degenerate (1e-6)."""


@dataclass(frozen=True)
class Decimated:
    """A mesh with fewer faces."""

    vertices: np.ndarray
    """(w, 3) float64."""
    faces: np.ndarray
    """(g, 3) int64."""
    source: np.ndarray
    """(w,) int64: the old vertex each one grew out of, itself perhaps moved."""
    reached: bool
    """Whether the target was reached."""


def decimate(
    vertices: np.ndarray,
    faces: np.ndarray,
    target: int,
    progress: Progress,
    *,
    region: Region | None = None,
) -> Decimated:
    """Collapse edges until ``target`` faces are left, or one more.

    A closed oriented 2-manifold stays one, every part with its genus; so do open ones, whose
    boundary stays as it is. No face turns over or folds back onto its neighbour. Vertices on the
    region's faces stay on them, and none leaves it.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
        Consistently oriented 2-manifold, every vertex used.
    target : int
        At least :data:`MIN_TARGET`; a mesh with fewer faces stays as it is.
    region : Region, optional
        The region that the mesh was made in, same frame.

    Raises
    ------
    MeshingError
        The target is too small, or the faces are no oriented manifold.
    Cancelled
        Through ``progress``.
    """
    if target < MIN_TARGET:
        raise MeshingError(
            f"A closed mesh of {target} faces does not exist.", f"Ask for {MIN_TARGET} or more."
        )
    faces = np.array(faces, np.int64).reshape(-1, 3)
    vertices = np.asarray(vertices, np.float64)
    if len(faces) <= target:
        return Decimated(vertices, faces, np.arange(len(vertices)), True)
    caps = cap_planes(vertices, region)
    # In units of the mesh's own size: neither metres nor UTM coordinates change a decision.
    low, high = vertices[faces].min((0, 1)), vertices[faces].max((0, 1))
    center, size = (low + high) / 2, float(np.linalg.norm(high - low))
    if not (np.isfinite(size) and size > 0.0):
        raise MeshingError(
            "A mesh without a finite size cannot be decimated.", "Mesh the region again."
        )
    run = _Run((vertices - center) / size, faces, caps, center, size)
    first = len(faces)
    while True:
        before = run.faces_left
        share = (first - before) / (first - target)
        run.work(LIMITS, target, progress.span(min(share, 1.0), 1.0), first)
        # What was refused may be allowed now that its surroundings have changed.
        if run.faces_left <= target or run.faces_left == before:
            break
    kept = run.faces[run.faces[:, 0] >= 0]
    moved = run.stamps > 0
    result = np.where(moved[:, None], run.points * size + center, vertices)
    result, kept, source = compacted(result, kept)
    progress.update(1.0, f"{len(kept)} faces left")
    return Decimated(result, kept, source, len(kept) <= target)


class _Run:
    """The arrays that the kernels work on."""

    def __init__(
        self,
        points: np.ndarray,
        faces: np.ndarray,
        caps: CapPlanes,
        center: np.ndarray,
        size: float,
    ) -> None:
        count = len(points)
        self.points, self.faces = np.ascontiguousarray(points), faces
        self.stamps = np.zeros(count, np.int64)
        locked = caps.fixed | _on_boundary(faces, count)
        head, following = np.full(count, -1), np.full(faces.size, -1)
        kernels.link_corners(faces, head, following)
        quadrics = np.zeros((count, kernels.COLUMNS))
        kernels.face_quadrics(self.points, faces, quadrics)
        marks = np.zeros(count, np.int64)
        self._state = (
            self.points, faces, head, following, quadrics, self.stamps, caps.planes, locked, marks,
        )  # fmt: skip
        offsets = (caps.offsets - caps.normals @ center) / size
        self._region = (np.ascontiguousarray(caps.normals), offsets)
        self._counts = np.array([0, 0, len(faces), 0])
        self._scratch = np.zeros((8, 3))
        self._heap: tuple[np.ndarray, ...] = ()

    @property
    def faces_left(self) -> int:
        """Faces that still live."""
        return int(self._counts[kernels.FACES_LEFT])

    def work(self, limits: Limits, target: int, progress: Progress, first: int) -> None:
        """Look at every edge once, and at those that change again, until nothing is left to do."""
        self._counts[kernels.HEAP_SIZE] = 0
        self._heap = _heap(3 * self.faces_left)
        kernels.push_edges(self._state, self._region, self._heap, self._counts, self._scratch)
        start = self.faces_left
        while True:
            done = kernels.collapse_edges(
                self._state, self._region, self._heap, self._counts, np.array(limits),
                self._scratch, target, LOOKS_PER_CALL,
            )  # fmt: skip
            left = self.faces_left
            share = (start - left) / max(start - target, 1)
            progress.update(min(share, 1.0), f"{left} of {first} faces left")
            if done in (kernels.DONE, kernels.EMPTY):
                return
            if done == kernels.FULL:
                self._heap = tuple(np.concatenate([c, np.zeros_like(c)]) for c in self._heap)


def _heap(size: int) -> tuple[np.ndarray, ...]:
    size = max(size, 4 * kernels.MAX_RING)
    return (np.zeros(size), *(np.zeros(size, np.int64) for _ in range(5)))


def _on_boundary(faces: np.ndarray, count: int) -> np.ndarray:
    """(v,) bool: vertices at an edge with one face; refuses what is no oriented manifold."""
    begin, end = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    forward, backward = np.sort(begin * count + end), end * count + begin
    place = np.minimum(np.searchsorted(forward, backward), len(forward) - 1)
    if (forward[1:] == forward[:-1]).any() or (begin == end).any():
        raise MeshingError(
            "Only an oriented manifold can be decimated.",
            "Send the job folder's log.txt with a bug report.",
        )
    single = forward[place] != backward
    result = np.zeros(count, np.bool_)
    result[begin[single]] = True
    result[end[single]] = True
    return result
