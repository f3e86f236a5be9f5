# SPDX-License-Identifier: GPL-3.0-or-later
"""Neighbours of tetrahedra, and the faces between inside and outside tetrahedra."""

from __future__ import annotations

import numpy as np

OUTWARD_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Corners of the face opposite each corner of a positively oriented tetrahedron, outward."""

_KEY_BITS = 21


def tetrahedron_neighbours(tetrahedra: np.ndarray) -> np.ndarray:
    """Return the tetrahedron behind the face opposite each corner, -1 on the hull, (m, 4) int64.

    No face may belong to more than two tetrahedra.
    """
    count = len(tetrahedra)
    triples = np.sort(tetrahedra[:, OUTWARD_FACES].reshape(-1, 3), 1)  # (4m, 3)
    if count and int(triples.max()) < 1 << _KEY_BITS:
        keys = (triples[:, 0] << 2 * _KEY_BITS) | (triples[:, 1] << _KEY_BITS) | triples[:, 2]
        order = np.argsort(keys, kind="stable")
        same = keys[order[1:]] == keys[order[:-1]]
    else:
        order = np.lexsort((triples[:, 2], triples[:, 1], triples[:, 0]))
        same = (triples[order[1:]] == triples[order[:-1]]).all(1)
    first, second = order[:-1][same], order[1:][same]
    result = np.full(4 * count, -1, np.int64)
    result[first], result[second] = second // 4, first // 4
    return result.reshape(count, 4)


def boundary_faces(
    tetrahedra: np.ndarray, neighbours: np.ndarray, inside: np.ndarray
) -> np.ndarray:
    """Return the faces of inside tetrahedra with an outside neighbour or none, (f, 3) int64.

    Oriented outward where the tetrahedra are positively oriented. The set is closed: every edge
    has as many faces in one direction as in the other.
    """
    beyond = np.where(neighbours >= 0, inside[neighbours], False)  # (m, 4)
    tetrahedron, corner = np.nonzero(inside[:, None] & ~beyond)
    return tetrahedra[tetrahedron[:, None], OUTWARD_FACES[corner]]
