# SPDX-License-Identifier: GPL-3.0-or-later
"""Faces between the tetrahedra of different tiles: on the surface where one of them is solid."""

from __future__ import annotations

import numpy as np

from ...errors import MeshingError

_NO_FACES = np.zeros((0, 3), np.int64)


def tiles_disagree() -> MeshingError:
    """Return the error that the faces of tiles do not fit together."""
    hint = "Use another seed or number of tiles."
    return MeshingError("Tiles do not agree on their border.", hint)


class BorderFaces:
    """Holds the faces that one tile has listed until the other one has, too.

    A face listed by a single tile, when all tiles at one of its corners are there, lies on the
    region's boundary.
    """

    def __init__(self) -> None:
        self._faces, self._solid = _NO_FACES, np.zeros(0, np.bool_)
        self._settled = np.zeros(0, np.bool_)

    def add(self, faces: np.ndarray, solid: np.ndarray) -> np.ndarray:
        """Add the border faces of a tile; return those of the surface that this settles.

        Parameters
        ----------
        faces : (b, 3) int
            Indices of points, oriented out of the tile.
        solid : (b,) bool
            Whether the tile's tetrahedron at each is inside.

        Returns
        -------
        (k, 3) int64
            Oriented outward.

        Raises
        ------
        MeshingError
            Two tiles have triangulated the points near their border differently.
        """
        border = np.concatenate([self._faces, faces])
        solid = np.concatenate([self._solid, solid])
        settled = np.concatenate([self._settled, np.zeros(len(faces), np.bool_)])
        low = np.sort(border, 1)
        order = np.lexsort((low[:, 2], low[:, 1], low[:, 0]))
        same = (low[order[1:]] == low[order[:-1]]).all(1)
        first, second = order[:-1][same], order[1:][same]
        turned = _parity(border[first]) != _parity(border[second])
        twice = settled[first] | settled[second]
        if (same[1:] & same[:-1]).any() or not turned.all() or twice.any():
            raise tiles_disagree()
        settled[first] = True
        surface = np.where(solid[first, None], border[first], border[second])
        surface = surface[solid[first] != solid[second]]
        # One of each pair stays, to notice a third.
        kept = np.ones(len(border), np.bool_)
        kept[second] = False
        self._faces, self._solid, self._settled = border[kept], solid[kept], settled[kept]
        return surface.astype(np.int64)

    def close(self, points: np.ndarray) -> np.ndarray:
        """Forget the faces at points whose tiles are all there; return those of the surface.

        Parameters
        ----------
        points : (p,) int
            Indices, increasing.
        """
        closed = np.isin(self._faces, points).any(1)
        surface = self._faces[closed & self._solid & ~self._settled]
        self._faces, self._solid = self._faces[~closed], self._solid[~closed]
        self._settled = self._settled[~closed]
        return surface


def _parity(faces: np.ndarray) -> np.ndarray:
    """Return the parity of the permutation that sorts the corners of each face, (f,) bool."""
    a, b, c = faces.T
    return (a < b) ^ (b < c) ^ (c < a)
