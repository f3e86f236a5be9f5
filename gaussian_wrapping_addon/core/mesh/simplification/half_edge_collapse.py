# SPDX-License-Identifier: GPL-3.0-or-later
"""Half-edge collapses: a vertex merges into a neighbour, and no vertex moves (numba).

The heap holds vertices with the cost of their cheapest collapse, in three columns: costs, vertices,
stamps. Changes two edges away may alter that cost without a new entry, so it is recomputed when a
vertex is popped.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...kernels.compiled import kernel, part
from .corners import merge_vertices, unlink_dead_faces
from .counters import DONE, EMPTY, FULL, HEAP_ROOM, HEAP_SIZE, PAUSED, VERTICES_LEFT
from .heap import pop_first, sift_up_last
from .link_condition import link_allows, mark_ring
from .quadrics import WEIGHT, area_vector, error_of_one

MAX_RING = 64
"""Most neighbours of a vertex that can be removed."""

HEAP_COLUMNS = 2
"""Integer columns of the heap: vertices and stamps."""


class ShapeBounds(NamedTuple):
    """Bounds on the faces around a removed vertex."""

    longest_squared: float
    """Square of the greatest length of a new edge."""
    shape_weight: float
    """Weight of squared length relative to squared height in the cost."""
    least_roundness: float
    """Least height over longest edge of a changed triangle, unless it was narrower before."""
    least_cosine: float
    """Least cosine between the normals of a triangle before and after."""


class MergeLog(NamedTuple):
    """Which vertices take part, and what has become of them."""

    locked: np.ndarray
    """(v,) bool: vertices that neither merge nor are merged into; all others have all their faces.
    """
    into: np.ndarray
    """(v,) int64: the vertex that each has merged into; filled."""
    level: np.ndarray
    """(v,) float64: the highest cost so far when it merged; filled."""
    highest: np.ndarray
    """(1,) float64: the highest cost so far."""


@part(fast=False)
def _shapes_allow(gone, stays, mesh, bounds):
    """Return whether all faces of ``gone`` stay within the bounds when it moves to ``stays``."""
    points, faces, head, following = mesh[0], mesh[1], mesh[2], mesh[3]
    longest_squared, _, least_roundness, least_cosine = bounds
    corner = head[gone]
    while corner >= 0:
        f, k = corner // 3, corner % 3
        corner = following[corner]
        b, c = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
        if b == stays or c == stays:
            continue
        ex, ey, ez = (
            points[c, 0] - points[b, 0], points[c, 1] - points[b, 1], points[c, 2] - points[b, 2],
        )  # fmt: skip
        ux, uy, uz = (
            points[gone, 0] - points[b, 0], points[gone, 1] - points[b, 1],
            points[gone, 2] - points[b, 2],
        )  # fmt: skip
        wx, wy, wz = (
            points[stays, 0] - points[b, 0], points[stays, 1] - points[b, 1],
            points[stays, 2] - points[b, 2],
        )  # fmt: skip
        nx, ny, nz = area_vector(points, points[b, 0], points[b, 1], points[b, 2], c, gone)
        mx, my, mz = area_vector(points, points[b, 0], points[b, 1], points[b, 2], c, stays)
        before = np.sqrt(nx * nx + ny * ny + nz * nz)
        after = np.sqrt(mx * mx + my * my + mz * mz)
        if not (nx * mx + ny * my + nz * mz > least_cosine * before * after):
            return False
        side = ex * ex + ey * ey + ez * ez
        old = max(side, ux * ux + uy * uy + uz * uz)
        old = max(old, (ux - ex) ** 2 + (uy - ey) ** 2 + (uz - ez) ** 2)
        first = wx * wx + wy * wy + wz * wz
        second = (wx - ex) ** 2 + (wy - ey) ** 2 + (wz - ez) ** 2
        if first > longest_squared or second > longest_squared:
            return False
        new = max(side, first, second)
        # Roundness is twice the area over the longest edge squared.
        if after < min(least_roundness * new, before / old * new):
            return False
    return True


@part(fast=False)
def _cheapest(vertex, mesh, counts, bounds, locked, ring):
    """Return the neighbour that ``vertex`` merges into at the least cost, and the cost.

    (-1, inf) if there is none. Ties are broken by index, so the order of faces does not matter.
    """
    points, faces, head, following, quadrics = mesh[0], mesh[1], mesh[2], mesh[3], mesh[4]
    shape_weight = bounds[1]
    best, lowest = -1, np.inf
    if locked[vertex]:
        return best, lowest
    unlink_dead_faces(vertex, faces, head, following)
    around, mark = mark_ring(vertex, mesh, counts, ring)
    if around > MAX_RING:
        return best, lowest
    # No vertex merges into a neighbour with more faces than MAX_RING, although one with three
    # faces would leave it with that number.
    limit = MAX_RING - 1 if around == 3 else MAX_RING
    for i in range(around):
        stays = ring[i]
        if locked[stays]:
            continue
        square = 0.0
        for k in range(3):
            square += (points[vertex, k] - points[stays, k]) ** 2
        error = error_of_one(quadrics, vertex, points[stays, 0], points[stays, 1], points[stays, 2])
        price = error + shape_weight * quadrics[vertex, WEIGHT] * square
        if price > lowest or (price == lowest and stays > best):
            continue
        unlink_dead_faces(stays, faces, head, following)
        if not link_allows(vertex, stays, around, mark, limit, mesh, counts):
            continue
        if _shapes_allow(vertex, stays, mesh, bounds):
            best, lowest = stays, price
    return best, lowest


@part(fast=False)
def _push(vertex, price, stamp, heap, counts):
    slot = counts[HEAP_SIZE]
    heap[0][slot], heap[1][slot], heap[2][slot] = price, vertex, stamp
    sift_up_last(heap, counts)


@kernel(fast=False)
def push_vertices(mesh, heap, counts, bounds, log):
    """Push every removable vertex onto the empty heap, which must have room for all."""
    head, stamps = mesh[2], mesh[5]
    ring = np.empty(MAX_RING, np.int64)
    for vertex in range(len(head)):
        if head[vertex] >= 0:
            best, price = _cheapest(vertex, mesh, counts, bounds, log[0], ring)
            if best >= 0:
                _push(vertex, price, stamps[vertex], heap, counts)


@kernel(fast=False)
def collapse_half_edges(mesh, heap, counts, bounds, log, target, most, budget):
    """Merge the cheapest vertices into neighbours until ``target`` vertices are left.

    Parameters
    ----------
    mesh, heap, counts : tuple, tuple, array
        See :mod:`.corners`, above and :mod:`.counters`.
    bounds : tuple
        Values of :class:`ShapeBounds`.
    log : tuple
        Arrays of :class:`MergeLog`.
    most : float
        Highest cost of a merger.
    budget : int
        Greatest number of entries to pop.
    """
    stamps = mesh[5]
    locked, into, level, highest = log
    ring, changed = np.empty(MAX_RING, np.int64), np.empty(MAX_RING + 1, np.int64)
    room = len(heap[0]) - HEAP_ROOM
    for _ in range(budget):
        if counts[VERTICES_LEFT] <= target:
            return DONE
        if counts[HEAP_SIZE] == 0:
            return EMPTY
        if counts[HEAP_SIZE] > room:
            return FULL
        price, gone, stamp = heap[0][0], heap[1][0], heap[2][0]
        if price > most:
            return DONE
        pop_first(heap, counts)
        if stamps[gone] != stamp:
            continue
        stays, now = _cheapest(gone, mesh, counts, bounds, locked, ring)
        if stays < 0:
            continue
        if now > price:
            stamps[gone] += 1
            _push(gone, now, stamps[gone], heap, counts)
            continue
        merge_vertices(stays, gone, mesh, counts)
        highest[0] = max(highest[0], price)
        into[gone], level[gone] = stays, highest[0]
        around, _ = mark_ring(stays, mesh, counts, changed)
        changed[around] = stays
        for slot in range(around + 1):
            vertex = changed[slot]
            stamps[vertex] += 1
            best, price = _cheapest(vertex, mesh, counts, bounds, locked, ring)
            if best >= 0:
                _push(vertex, price, stamps[vertex], heap, counts)
    return PAUSED
