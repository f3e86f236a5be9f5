# SPDX-License-Identifier: GPL-3.0-or-later
"""Decimate a mesh by edge collapses that preserve a closed manifold, in order of quadric error.

Libraries that do the same break thin parts (their collapses join sheets) or fold faces over.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import MeshingError
from ...progress import Progress
from ...regions.cap_planes import CapPlanes, cap_planes
from ...regions.convex_region import Region
from ..components import compacted
from ..topology import half_edges, vertices_of_half_edges
from .engine import Heap, Simplification
from .optimal_collapse import HEAP_COLUMNS, POINT_WEIGHT, Limits, collapse_edges, push_edges

MIN_TARGET = 4
"""Faces of a tetrahedron: no closed surface has fewer."""

EDGES_PER_CALL = 100_000
"""Edges processed between two checks for cancellation: about 0.2 s."""


LIMITS = Limits(0.0, -0.97, 1e-4)
"""Bends up to 166 degrees, and no face turns over (90 degrees). Tighter bounds measured worse: they
force collapses where these cost more. Needles are allowed, since wires and plates need long narrow
faces; the bound is still far above what counts as degenerate (1e-6)."""


@dataclass(frozen=True)
class DecimationResult:
    """A mesh with fewer faces."""

    vertices: np.ndarray
    """(w, 3) float64."""
    faces: np.ndarray
    """(g, 3) int64."""
    source: np.ndarray
    """(w,) int64: the original vertex of each, which may have moved."""
    reached: bool
    """Whether the target was reached."""


def decimate(
    vertices: np.ndarray,
    faces: np.ndarray,
    target: int,
    progress: Progress,
    *,
    region: Region | None = None,
) -> DecimationResult:
    """Collapse edges until ``target`` faces are left, or one more.

    A closed oriented 2-manifold stays one, and every part keeps its genus; the same holds for open
    manifolds, whose boundary is kept. No face turns over or folds back onto its neighbour. Vertices
    on the region's faces stay on them, and none leaves it.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
        Consistently oriented 2-manifold, every vertex used.
    target : int
        At least :data:`MIN_TARGET`; a mesh with fewer faces is returned unchanged.
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
        return DecimationResult(vertices, faces, np.arange(len(vertices)), True)
    caps = cap_planes(vertices, region)
    # In units of the mesh's size: neither the unit nor UTM coordinates change a decision.
    low, high = vertices[faces].min((0, 1)), vertices[faces].max((0, 1))
    center, size = (low + high) / 2, float(np.linalg.norm(high - low))
    if not (np.isfinite(size) and size > 0.0):
        raise MeshingError(
            "A mesh without a finite size cannot be decimated.", "Mesh the region again."
        )
    run = _Decimation((vertices - center) / size, faces, caps, center, size)
    first = len(faces)
    while True:
        before = run.faces_left
        share = (first - before) / (first - target)
        run.collapse_pass(target, progress.span(min(share, 1.0), 1.0), first)
        # Refused collapses may be allowed now that their surroundings have changed.
        if run.faces_left <= target or run.faces_left == before:
            break
    moved = run.stamps > 0
    result = np.where(moved[:, None], run.points * size + center, vertices)
    result, kept, source = compacted(result, run.faces())
    progress.update(1.0, f"{len(kept)} faces left")
    return DecimationResult(result, kept, source, len(kept) <= target)


class _Decimation(Simplification):
    """Edge collapses that respect a region's planes."""

    def __init__(
        self,
        points: np.ndarray,
        faces: np.ndarray,
        caps: CapPlanes,
        center: np.ndarray,
        size: float,
    ) -> None:
        locked = caps.fixed | _on_boundary(faces, len(points))
        # Planes are weighted by the area of their face.
        super().__init__(points, faces, 0.5, POINT_WEIGHT)
        offsets = (caps.offsets - caps.normals @ center) / size
        self._caps = (caps.planes, locked, np.ascontiguousarray(caps.normals), offsets)
        self._scratch = np.zeros((8, 3))

    def collapse_pass(self, target: int, progress: Progress, first: int) -> None:
        """Process every edge once, and changed edges again, until the heap is empty."""
        heap = self.empty_heap(3 * self.faces_left, HEAP_COLUMNS)
        push_edges(self.mesh, self._caps, heap, self.counts, self._scratch)
        start = self.faces_left

        def collapse(heap: Heap) -> int:
            return collapse_edges(
                self.mesh, self._caps, heap, self.counts, tuple(LIMITS), self._scratch, target,
                EDGES_PER_CALL,
            )  # fmt: skip

        def report() -> None:
            left = self.faces_left
            share = (start - left) / max(start - target, 1)
            progress.update(min(share, 1.0), f"{left} of {first} faces left")

        self.run(heap, collapse, report)


def _on_boundary(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the vertices at boundary edges, (v,) bool; reject what is no oriented manifold."""
    begin, end = half_edges(faces)
    forward, backward = np.sort(begin * count + end), end * count + begin
    position = np.minimum(np.searchsorted(forward, backward), len(forward) - 1)
    if (forward[1:] == forward[:-1]).any() or (begin == end).any():
        raise MeshingError(
            "Only an oriented manifold can be decimated.",
            "Send the job folder's log.txt with a bug report.",
        )
    return vertices_of_half_edges(forward[position] != backward, faces, count)
