# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse cubic lattice: only the cells that hold a sample exist, in two nested sizes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RATIO = 4
"""Coarse cells are this many fine cells wide."""
_AXIS_BITS = 19
"""Bits of a coarse cell's index along an axis: three of them and a fine cell's number within the
coarse one (6 bits) fill 63 bits."""
MIN_CELL = 4.0 / (RATIO * ((1 << _AXIS_BITS) - 2))
"""Smallest side of a fine cell, so that all of the contracted space (4 across) can be numbered."""
CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.int64)
"""(8, 3) offsets of a cell's corners; corner ``4 i + 2 j + k``."""


@dataclass(frozen=True)
class Level:
    """Cells of one size and their corners."""

    cells: np.ndarray
    """(c,) int64 keys, increasing."""
    corners: np.ndarray
    """(c, 8) int32: vertices of each cell."""
    vertices: np.ndarray
    """(v,) int64 keys, increasing."""
    incident: np.ndarray
    """(v, 8) int32: ``8 cell + corner`` of the cells around a vertex, -1 where there is none."""

    @classmethod
    def of_cells(cls, keys: np.ndarray, indices: np.ndarray) -> Level:
        """Return the level of the given cells.

        Parameters
        ----------
        keys : (c,) int64
            Increasing.
        indices : (c, 3) int64
            Of the cells along each axis.
        """
        corner_keys = pack(indices[:, None, :] + CORNERS)  # (c, 8)
        vertices, inverse = np.unique(corner_keys, return_inverse=True)
        corners = inverse.reshape(corner_keys.shape).astype(np.int32)
        incident = np.full((len(vertices), 8), -1, np.int32)
        numbers = np.arange(len(keys), dtype=np.int32) * 8
        for corner in range(8):
            incident[corners[:, corner], corner] = numbers + corner
        return cls(keys, corners, vertices, incident)

    def find(self, keys: np.ndarray, indices: np.ndarray) -> np.ndarray:
        """Return (n, 8) int32 vertices of the given cells, -1 where the lattice has none."""
        found = _search(self.cells, keys)
        vertices = self.corners[found.clip(0)]
        missing = np.flatnonzero(found < 0)
        vertices[missing] = _search(self.vertices, pack(indices[missing][:, None, :] + CORNERS))
        return vertices


def pack(indices: np.ndarray) -> np.ndarray:
    """Return one int64 for three indices (..., 3), each >= 0 and below 2^21."""
    return (indices[..., 0] << 42) | (indices[..., 1] << 21) | indices[..., 2]


def locate(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the fine cells of contracted points and the positions in them.

    Parameters
    ----------
    points : (n, 3) float64
        In [-2, 2].
    cell : float
        Side of a fine cell, at least :data:`MIN_CELL`.

    Returns
    -------
    keys : (n,) int64
        ``key // RATIO^3`` numbers the coarse cell, so that in increasing order all fine cells of a
        coarse one are together.
    indices : (n, 3) int64
        Of the fine cells along each axis.
    places : (n, 3) float32
        In [0, 1).
    """
    scaled = (points + 2.0) / cell
    indices = np.floor(scaled).astype(np.int64)
    places = (scaled - indices).astype(np.float32)
    coarse, sub = indices // RATIO, indices % RATIO
    inside = (sub[:, 0] * RATIO + sub[:, 1]) * RATIO + sub[:, 2]
    number = (coarse[:, 0] << _AXIS_BITS | coarse[:, 1]) << _AXIS_BITS | coarse[:, 2]
    return number * RATIO**3 + inside, indices, places


def _search(sorted_keys: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return the positions of keys in an increasing array, int32, -1 where absent."""
    at = np.searchsorted(sorted_keys, keys).clip(0, len(sorted_keys) - 1)
    return np.where(sorted_keys[at] == keys, at, -1).astype(np.int32)
