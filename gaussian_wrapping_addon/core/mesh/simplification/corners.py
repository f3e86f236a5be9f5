# SPDX-License-Identifier: GPL-3.0-or-later
"""Linked lists of the corners at each vertex during edge collapses, and vertex merging (numba).

The corners (3 face + k) of a vertex are linked: ``head[v]`` is its first, ``following[corner]`` the
next, -1 ends. Dead faces have -1 as first corner and stay linked until :func:`unlink_dead_faces`.

``mesh`` is the tuple of points (v, 3) float64, faces (f, 3) int64, head (v,) int64, following (3f,)
int64, quadrics (v, 11) float64, stamps (v,) int64 (how often a vertex has changed) and marks (v,)
int64 (see :mod:`.link_condition`). All are modified in place.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from ...kernels.compiled import kernel, part
from .counters import FACES_LEFT, VERTICES_LEFT


@kernel(fast=False)
def link_corners(faces, head, following):
    """Fill ``head`` and ``following``; corners of a vertex are in increasing order."""
    for f in range(len(faces) - 1, -1, -1):
        if faces[f, 0] < 0:
            continue
        for k in range(2, -1, -1):
            v = faces[f, k]
            following[3 * f + k] = head[v]
            head[v] = 3 * f + k


@part(fast=False)
def unlink_dead_faces(v, faces, head, following):
    """Remove dead faces from the list of ``v``; return its last corner."""
    last, corner = -1, head[v]
    while corner >= 0:
        after = following[corner]
        if faces[corner // 3, 0] < 0:
            if last < 0:
                head[v] = after
            else:
                following[last] = after
        else:
            last = corner
        corner = after
    return last


@part(fast=False)
def merge_vertices(u, v, mesh, counts):
    """Merge ``v`` into ``u``; the link condition must hold and dead faces be unlinked."""
    _, faces, head, following, quadrics, stamps, _ = mesh
    corner = head[v]
    while corner >= 0:
        f, k = corner // 3, corner % 3
        if faces[f, (k + 1) % 3] == u or faces[f, (k + 2) % 3] == u:
            faces[f, 0] = -1
            counts[FACES_LEFT] -= 1
        else:
            faces[f, k] = u
        corner = following[corner]
    counts[VERTICES_LEFT] -= 1
    last = unlink_dead_faces(u, faces, head, following)
    if last < 0:
        head[u] = head[v]
    else:
        following[last] = head[v]
    head[v] = -1
    unlink_dead_faces(u, faces, head, following)
    quadrics[u] += quadrics[v]
    stamps[u] += 1
    stamps[v] += 1
