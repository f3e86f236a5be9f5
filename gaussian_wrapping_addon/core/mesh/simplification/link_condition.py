# SPDX-License-Identifier: GPL-3.0-or-later
"""Link condition: which edges can be collapsed without changing the topology (numba).

Dey, Edelsbrunner, Guha and Nekhayev, "Topology preserving edge contraction" (1999). Members of a
ring are marked with increasing numbers, so that marks need not be erased.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from ...kernels.compiled import part
from .counters import LAST_MARK


@part(fast=False)
def mark_ring(u, mesh, counts, ring):
    """Mark the neighbours of ``u``; return the number of its faces, and the mark.

    The marks are valid until another ring is marked. Dead faces must have been unlinked. ``ring``
    (n,) is filled with the vertices that follow ``u`` in its faces, as many as fit: on a closed
    mesh, each neighbour once.
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
    """Return whether the surface stays a manifold when ``u`` and ``v`` merge.

    Parameters
    ----------
    around_u, mark : int
        From :func:`mark_ring` for ``u``.
    max_ring : int
        Most faces around the merged vertex.
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
