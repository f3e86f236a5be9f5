# SPDX-License-Identifier: GPL-3.0-or-later
"""Edge collapses with optimal placement, each validated before it is made (numba).

The heap holds edges in six columns: costs, sequence numbers, stamps (the sum of both ends'), first
and second ends, kinds of placement. If the optimal position is refused, the ends are tried.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...kernels.compiled import kernel, part
from .corners import merge_vertices, unlink_dead_faces
from .counters import DONE, EMPTY, FACES_LEFT, FULL, HEAP_ROOM, HEAP_SIZE, PAUSED, SEQUENCE
from .heap import pop_first, sift_up_last
from .link_condition import link_allows, mark_ring
from .optimal_placement import FIRST, OPTIMAL, SECOND, on_planes_of, place_merged
from .quadrics import area_vector

POINT_WEIGHT = 1e-7
"""Weight of the distance to the vertices relative to the distance to the planes. It makes the
optimum unique on flat patches; 1e-4 would make collapses across a thin plate cheaper than along it.
"""

MAX_RING = 48
"""Most faces around a merged vertex: fans of needles bake and subdivide badly."""

HEAP_COLUMNS = 5
"""Integer columns of the heap."""


class Limits(NamedTuple):
    """Bounds on the faces around a collapsed edge."""

    turn_cos: float
    """Cosine of the largest rotation of a face in one collapse."""
    fold_cos: float
    """Cosine of the sharpest new bend between neighbours: -1 is folded back flat."""
    min_shape: float
    """Least height of a new face over its longest edge, unless the face was narrower before."""


@part(fast=False)
def _push(u, v, first_kind, mesh, caps, heap, counts, scratch):
    """Push an edge onto the heap if a placement of the merged vertex exists."""
    cost, kind = np.inf, first_kind
    if first_kind == OPTIMAL:
        cost = place_merged(u, v, OPTIMAL, mesh, caps, scratch)
    if not cost < np.inf and first_kind != SECOND:
        cost, kind = place_merged(u, v, FIRST, mesh, caps, scratch), FIRST
        other = place_merged(u, v, SECOND, mesh, caps, scratch)
        if other < cost:
            # Exchange the ends, so that the cheaper one is always tried first.
            u, v, cost = v, u, other
    elif first_kind == SECOND:
        cost = place_merged(u, v, SECOND, mesh, caps, scratch)
    if not cost < np.inf:
        return
    stamps, slot = mesh[5], counts[HEAP_SIZE]
    heap[0][slot], heap[1][slot] = cost, counts[SEQUENCE]
    heap[2][slot] = stamps[u] + stamps[v]
    heap[3][slot], heap[4][slot], heap[5][slot] = u, v, kind
    counts[SEQUENCE] += 1
    sift_up_last(heap, counts)


@part(fast=False)
def _opposite_face(b, c, mesh, skip_u, skip_v):
    """Return the face opposite the half-edge b -> c if it contains neither end, else -1."""
    faces, head, following = mesh[1], mesh[2], mesh[3]
    corner = head[b]
    while corner >= 0:
        f, k = corner // 3, corner % 3
        if faces[f, 0] >= 0 and faces[f, (k + 2) % 3] == c:
            apex = faces[f, (k + 1) % 3]
            return -1 if apex in (skip_u, skip_v) else f
        corner = following[corner]
    return -1


@part(fast=False)
def _shapes_allow(u, v, mesh, limits, place, ring, ring_normals):
    """Return the number of remaining faces, or -1 if a face violates the limits.

    A face must not turn over, fold back onto a neighbour or become a needle. ``ring`` and
    ``ring_normals`` are filled with the outer edges and new unit normals of the remaining faces.
    """
    points, faces, head, following = mesh[0], mesh[1], mesh[2], mesh[3]
    turn_cos, fold_cos, min_shape = limits
    x, y, z = place[0], place[1], place[2]
    size = 0
    for side in range(2):
        centre, other = (u, v) if side == 0 else (v, u)
        corner = head[centre]
        while corner >= 0:
            f, k = corner // 3, corner % 3
            corner = following[corner]
            b, c = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            if b == other or c == other:
                continue
            ox, oy, oz = area_vector(
                points, points[centre, 0], points[centre, 1], points[centre, 2], b, c
            )
            nx, ny, nz = area_vector(points, x, y, z, b, c)
            old, new = np.sqrt(ox * ox + oy * oy + oz * oz), np.sqrt(nx * nx + ny * ny + nz * nz)
            if not new > 0.0:
                return -1
            if nx * ox + ny * oy + nz * oz < turn_cos * new * old:
                return -1
            old_long, new_long, outer = 0.0, 0.0, 0.0
            for i in range(3):
                outer += (points[b, i] - points[c, i]) ** 2
            for end in (b, c):
                reach_old, reach_new = 0.0, 0.0
                for i in range(3):
                    reach_old += (points[end, i] - points[centre, i]) ** 2
                    reach_new += (points[end, i] - place[i]) ** 2
                old_long, new_long = max(old_long, reach_old), max(new_long, reach_new)
            old_long, new_long = max(old_long, outer), max(new_long, outer)
            # Height over longest edge: twice the area over its square.
            if new < min_shape * new_long and new * old_long < old * new_long:
                return -1
            ring[size, 0], ring[size, 1] = b, c
            ring_normals[size, 0], ring_normals[size, 1] = nx / new, ny / new
            ring_normals[size, 2] = nz / new
            beyond = _opposite_face(b, c, mesh, u, v)
            if beyond >= 0:
                a = faces[beyond, 0]
                mx, my, mz = area_vector(
                    points, points[a, 0], points[a, 1], points[a, 2],
                    faces[beyond, 1], faces[beyond, 2],
                )  # fmt: skip
                length = np.sqrt(mx * mx + my * my + mz * mz)
                bend = (nx * mx + ny * my + nz * mz) * old
                before = (ox * mx + oy * my + oz * mz) * new
                if bend < fold_cos * new * old * length and bend < before:
                    return -1
            size += 1
    for i in range(size):
        for j in range(size):
            if ring[j, 0] == ring[i, 1]:
                bend = 0.0
                for k in range(3):
                    bend += ring_normals[i, k] * ring_normals[j, k]
                if bend < fold_cos:
                    return -1
    return size


@part(fast=False)
def _merge(u, v, mesh, caps, counts, place):
    """Merge ``v`` into ``u`` at ``place``, on the planes of both."""
    points, planes, locked = mesh[0], caps[0], caps[1]
    merge_vertices(u, v, mesh, counts)
    if not on_planes_of(planes, v, u):
        planes[u] = planes[v]
    points[u] = place
    locked[u] = locked[u] or locked[v]


@kernel(fast=False)
def push_edges(mesh, caps, heap, counts, scratch):
    """Push every edge onto the empty heap, which must have room for half of all corners."""
    faces = mesh[1]
    for f in range(len(faces)):
        if faces[f, 0] >= 0:
            for k in range(3):
                u, v = faces[f, k], faces[f, (k + 1) % 3]
                if u < v:
                    _push(u, v, OPTIMAL, mesh, caps, heap, counts, scratch)


@kernel(fast=False)
def collapse_edges(mesh, caps, heap, counts, limits, scratch, target, budget):
    """Collapse the cheapest edges until ``target`` faces are left.

    Parameters
    ----------
    mesh, caps, heap, counts : tuple, tuple, tuple, array
        See :mod:`.corners`, :mod:`.optimal_placement`, above and :mod:`.counters`.
    limits : tuple
        Values of :class:`Limits`.
    work : (8, 3) float64
        Scratch.
    budget : int
        Greatest number of entries to pop.
    """
    faces, head, following, stamps = mesh[1], mesh[2], mesh[3], mesh[5]
    unused = np.empty(0, np.int64)
    ring = np.empty((MAX_RING + 4, 2), np.int64)
    ring_normals = np.empty((MAX_RING + 4, 3), np.float64)
    place = scratch[0]
    room = len(heap[0]) - HEAP_ROOM
    for _ in range(budget):
        if counts[FACES_LEFT] <= target:
            return DONE
        if counts[HEAP_SIZE] == 0:
            return EMPTY
        if counts[HEAP_SIZE] > room:
            return FULL
        u, v, kind = heap[3][0], heap[4][0], heap[5][0]
        current = stamps[u] + stamps[v] == heap[2][0]
        pop_first(heap, counts)
        if not current or head[u] < 0 or head[v] < 0:
            continue
        unlink_dead_faces(u, faces, head, following)
        unlink_dead_faces(v, faces, head, following)
        around, mark = mark_ring(u, mesh, counts, unused)
        if not link_allows(u, v, around, mark, MAX_RING, mesh, counts):
            continue
        place_merged(u, v, kind, mesh, caps, scratch)
        size = _shapes_allow(u, v, mesh, limits, place, ring, ring_normals)
        if size < 0:
            if kind != SECOND:
                _push(u, v, kind + 1, mesh, caps, heap, counts, scratch)
            continue
        _merge(u, v, mesh, caps, counts, place)
        for i in range(size):
            _push(u, ring[i, 0], OPTIMAL, mesh, caps, heap, counts, scratch)
    return PAUSED
