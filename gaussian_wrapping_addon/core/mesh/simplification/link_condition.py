# SPDX-License-Identifier: GPL-3.0-or-later
"""The link condition: which edges can collapse so that a manifold stays one (numba).

Dey, Edelsbrunner, Guha and Nekhayev, "Topology preserving edge contraction" (1999). Members of a
ring are marked with numbers that only grow, so that no mark has to be erased.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from ...kernels.compiled import part
from .counters import LAST_MARK


@part(fast=False)
def mark_ring(u, mesh, counts, ring):
    """Mark the neighbours of ``u``; return the number of its faces, and the mark.

    The marks hold until another ring is marked. Dead faces must have been dropped. ``ring`` (n,) is
    filled with the vertices that follow ``u`` in its faces, as many as fit: where the mesh is
    closed, that is each neighbour once.
    """
    faces, head, following, marks = mesh[1], mesh[2], mesh[3], mesh[6]
    counts[LAST_MARK] += 1
    mark = counts[LAST_MARK]
    around = 0
    corner = head[u]
    while corner >= 0:
        f, k = corner // 3, corner % 3
        b, c = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
        marks[b], marks[c] = mark, mark
        if around < len(ring):
            ring[around] = b
        around += 1
        corner = following[corner]
    return around, mark


@part(fast=False)
def link_allows(u, v, around_u, mark, max_ring, mesh, counts):
    """Tell whether the surface stays a manifold when ``u`` and ``v`` merge.

    Parameters
    ----------
    around_u, mark : int
        Of :func:`mark_ring` for ``u``.
    max_ring : int
        Faces around the merged vertex at most.
    """
    faces, head, following, marks = mesh[1], mesh[2], mesh[3], mesh[6]
    counts[LAST_MARK] += 1
    seen = counts[LAST_MARK]
    around_v, shared, common = 0, 0, 0
    corner = head[v]
    while corner >= 0:
        f, k = corner // 3, corner % 3
        around_v += 1
        for step in range(1, 3):
            w = faces[f, (k + step) % 3]
            if w == u:
                shared += 1
            elif mark <= marks[w] < seen:
                marks[w] = seen
                common += 1
        corner = following[corner]
    if shared != 2 or common != 2 or around_u + around_v - 4 > max_ring:
        return False
    return not (around_u == 3 and around_v == 3)  # a tetrahedron
