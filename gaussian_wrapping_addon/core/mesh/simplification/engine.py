# SPDX-License-Identifier: GPL-3.0-or-later
"""State of a simplification run, and the driver loop of its collapse kernels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .corners import link_corners
from .counters import (
    COUNTERS,
    DONE,
    EMPTY,
    FACES_LEFT,
    FULL,
    HEAP_ROOM,
    HEAP_SIZE,
    VERTICES_LEFT,
)
from .quadrics import COLUMNS, add_face_quadrics

Heap = tuple[np.ndarray, ...]
"""See :mod:`.heap`."""


class Simplification:
    """A mesh under simplification, modified in place.

    Parameters
    ----------
    points : (v, 3) float64
        In units of about the mesh's size.
    faces : (f, 3) int64
        Oriented 2-manifold; modified in place.
    scale, point_weight : float
        See :func:`.quadrics.add_face_quadrics`.
    quadrics : (v, 11) float64, optional
        Instead of those of the faces; modified in place.
    """

    def __init__(
        self,
        points: np.ndarray,
        faces: np.ndarray,
        scale: float,
        point_weight: float,
        quadrics: np.ndarray | None = None,
    ) -> None:
        count = len(points)
        head, following = np.full(count, -1, np.int64), np.full(faces.size, -1, np.int64)
        link_corners(faces, head, following)
        self.points, self._faces = np.ascontiguousarray(points), faces
        self.stamps = np.zeros(count, np.int64)
        if quadrics is None:
            quadrics = np.zeros((count, COLUMNS))
            add_face_quadrics(self.points, faces, quadrics, scale, point_weight)
        marks = np.zeros(count, np.int64)
        self.mesh = (self.points, faces, head, following, quadrics, self.stamps, marks)
        """The tuple that kernels take, see :mod:`.corners`."""
        self.counts = np.zeros(COUNTERS, np.int64)
        """See :mod:`.counters`."""
        self.counts[FACES_LEFT] = len(faces)
        self.counts[VERTICES_LEFT] = (head >= 0).sum()

    @property
    def faces_left(self) -> int:
        """Number of remaining faces."""
        return int(self.counts[FACES_LEFT])

    def faces(self) -> np.ndarray:
        """Return the remaining faces, (g, 3) int64, in their original order."""
        return self._faces[self._faces[:, 0] >= 0]

    def empty_heap(self, size: int, columns: int) -> Heap:
        """Return a heap for at least ``size`` entries with this many integer columns."""
        self.counts[HEAP_SIZE] = 0
        size = max(size, 2 * HEAP_ROOM)
        return (np.zeros(size), *(np.zeros(size, np.int64) for _ in range(columns)))

    def run(
        self,
        heap: Heap,
        collapse: Callable[[Heap], int],
        after: Callable[[], None] | None = None,
    ) -> None:
        """Call a collapse kernel until its target is reached or its heap empty.

        Parameters
        ----------
        collapse : callable
            Continues with the heap; returns a code such as :data:`.counters.DONE`.
        after : callable, optional
            Called after every call, for progress.
        """
        while True:
            state = collapse(heap)
            if after is not None:
                after()
            if state in (DONE, EMPTY):
                return
            if state == FULL:
                heap = tuple(_twice_as_long(column) for column in heap)


def _twice_as_long(column: np.ndarray) -> np.ndarray:
    result = np.zeros(2 * len(column), column.dtype)
    result[: len(column)] = column
    return result
