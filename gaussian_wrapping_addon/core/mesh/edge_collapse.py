# SPDX-License-Identifier: GPL-3.0-or-later
"""Quadric edge collapses: kernels."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compiled import kernel, part

# -- Counters and return codes of the collapse kernels --------------------------------------------

HEAP_SIZE, SEQUENCE, FACES_LEFT, VERTICES_LEFT, LAST_MARK = 0, 1, 2, 3, 4
"""Indices into ``counts``, (5,) int64: heap entries in use, number of the next entry, remaining
faces and used vertices, last mark given (see below)."""

COUNTERS = 5  # length of ``counts``

DONE, EMPTY, FULL, PAUSED = 0, 1, 2, 3
"""Why a collapse kernel returned: target reached, heap empty, heap full, budget spent."""

HEAP_ROOM = 128  # free heap entries required before a collapse: more than one collapse adds


# -- Binary heap over columns, so that a long run can pause, grow the heap and resume (numba) -----
#
# A heap is a tuple of arrays of equal length: costs float64, ties int64, then any int64 columns.
# The entry with the least (cost, tie) comes first; ``counts[HEAP_SIZE]`` entries are in use.


@part(fast=False)
def _less(heap, a, b):
    costs, ties = heap[0], heap[1]
    return costs[a] < costs[b] or (costs[a] == costs[b] and ties[a] < ties[b])


@part(fast=False)
def _swap(heap, a, b):
    for column in heap[1:]:
        kept = column[a]
        column[a] = column[b]
        column[b] = kept
    cost = heap[0][a]
    heap[0][a] = heap[0][b]
    heap[0][b] = cost


@part(fast=False)
def sift_up_last(heap, counts):
    """Add the entry that was written after the last one."""
    slot = counts[HEAP_SIZE]
    counts[HEAP_SIZE] += 1
    while slot > 0 and _less(heap, slot, (slot - 1) // 2):
        _swap(heap, slot, (slot - 1) // 2)
        slot = (slot - 1) // 2


@part(fast=False)
def _copy(heap, source, target):
    heap[0][target] = heap[0][source]
    for column in heap[1:]:
        column[target] = column[source]


@part(fast=False)
def pop_first(heap, counts):
    """Remove the cheapest entry."""
    last = counts[HEAP_SIZE] - 1
    counts[HEAP_SIZE] = last
    # The last entry fills the hole at the end of the path of smaller children.
    slot = 0
    while True:
        child = 2 * slot + 1
        if child >= last:
            break
        if child + 1 < last and _less(heap, child + 1, child):
            child += 1
        if not _less(heap, child, last):
            break
        _copy(heap, child, slot)
        slot = child
    _copy(heap, last, slot)


# -- Linked lists of the corners at each vertex during edge collapses, and vertex merging (numba)
#
# The corners (3 face + k) of a vertex are linked: ``head[v]`` is its first, ``following[corner]``
# the next, -1 ends. Dead faces have -1 as first corner and stay linked until
# :func:`unlink_dead_faces`.
#
# ``mesh`` is the tuple of points (v, 3) float64, faces (f, 3) int64, head (v,) int64, following
# (3f,) int64, quadrics (v, 11) float64, stamps (v,) int64 (how often a vertex has changed) and
# marks (v,) int64 (see :func:`mark_ring`). All are modified in place.


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


# -- Link condition: which edges can be collapsed without changing the topology (numba) -----------
#
# Dey, Edelsbrunner, Guha and Nekhayev, "Topology preserving edge contraction" (1999). Members of
# a ring are marked with increasing numbers, so that marks need not be erased.


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

    ``around_u`` and ``mark`` come from :func:`mark_ring` for ``u``; ``max_ring`` is the most faces
    around the merged vertex.
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


# -- Quadric error metrics: area-weighted squared distances to planes (numba) ---------------------
#
# Garland and Heckbert, "Surface simplification using quadric error metrics" (1997). A quadric is
# stored as (xx, xy, xz, yy, yz, zz, bx, by, bz, c, w): the error at p is p'Ap - 2 b'p + c, and w
# is the total weight of the planes. Each collapse strategy evaluates it in its own order of
# operations, on which its results depend in the last digits.

COLUMNS = 11  # of a quadric
WEIGHT = 10  # column of the planes' total weight


@kernel(fast=False)
def add_face_quadrics(points, faces, quadrics, scale, point_weight):
    """Add the plane of each face to the quadrics of its three corners.

    ``scale`` is the weight of a plane per length of the area vector, which is twice the area;
    ``point_weight`` that of the squared distance to the corner itself, relative to the plane's.
    """
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        nx, ny, nz = area_vector(points, points[a, 0], points[a, 1], points[a, 2], b, c)
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length <= 0.0:
            continue
        w = scale * length
        e = point_weight * w
        nx, ny, nz = nx / length, ny / length, nz / length
        d = nx * points[a, 0] + ny * points[a, 1] + nz * points[a, 2]
        for k in range(3):
            q = quadrics[faces[f, k]]
            x, y, z = points[faces[f, k], 0], points[faces[f, k], 1], points[faces[f, k], 2]
            q[0] += w * nx * nx + e
            q[1] += w * nx * ny
            q[2] += w * nx * nz
            q[3] += w * ny * ny + e
            q[4] += w * ny * nz
            q[5] += w * nz * nz + e
            q[6] += w * nx * d + e * x
            q[7] += w * ny * d + e * y
            q[8] += w * nz * d + e * z
            q[9] += w * d * d + e * (x * x + y * y + z * z)
            q[WEIGHT] += w


@part(fast=False)
def area_vector(points, x, y, z, b, c):
    """Return twice the area vector of the face (p, b, c) with p = (x, y, z)."""
    ux, uy, uz = points[b, 0] - x, points[b, 1] - y, points[b, 2] - z
    vx, vy, vz = points[c, 0] - x, points[c, 1] - y, points[c, 2] - z
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@part(fast=False)
def error_of_one(quadrics, vertex, x, y, z):
    """Return the error of one vertex's quadric at (x, y, z), at least 0."""
    q = quadrics[vertex]
    value = (
        x * (q[0] * x + 2.0 * (q[1] * y + q[2] * z - q[6]))
        + y * (q[3] * y + 2.0 * (q[4] * z - q[7]))
        + z * (q[5] * z - 2.0 * q[8])
        + q[9]
    )
    return max(value, 0.0)


@part(fast=False)
def error_of_both(quadrics, u, v, x, y, z):
    """Return the error of the sum of two vertices' quadrics at (x, y, z), at least 0."""
    q, r = quadrics[u], quadrics[v]
    ax = (q[0] + r[0]) * x + (q[1] + r[1]) * y + (q[2] + r[2]) * z
    ay = (q[1] + r[1]) * x + (q[3] + r[3]) * y + (q[4] + r[4]) * z
    az = (q[2] + r[2]) * x + (q[4] + r[4]) * y + (q[5] + r[5]) * z
    bx, by, bz = q[6] + r[6], q[7] + r[7], q[8] + r[8]
    value = x * (ax - 2.0 * bx) + y * (ay - 2.0 * by) + z * (az - 2.0 * bz) + q[9] + r[9]
    return max(value, 0.0)


# -- Optimal position of a merged vertex: least error on the planes of its ends (numba) -----------
#
# ``caps`` is the tuple of planes (v, 3) int64 that each vertex lies on (-1: none), locked (v,)
# bool, normals (k, 3) and offsets (k,) float64: inside is ``normal . x <= offset``.

OPTIMAL, FIRST, SECOND = 0, 1, 2
"""Placements of the merged vertex: at the least error, or at one of the ends."""


@part(fast=False)
def on_planes_of(planes, u, v):
    """Return whether ``v`` lies on every plane that ``u`` lies on."""
    for i in range(3):
        if planes[u, i] >= 0:
            found = False
            for j in range(3):
                found = found or planes[v, j] == planes[u, i]
            if not found:
                return False
    return True


@part(fast=False)
def _free_directions(planes, normals, v, basis):
    """Fill ``basis`` with an orthonormal basis of the directions in which ``v`` may move.

    Returns their number.
    """
    count = 0
    for i in range(3):
        if planes[v, i] >= 0:
            count += 1
    if count == 0:
        for i in range(3):
            for j in range(3):
                basis[i, j] = 1.0 if i == j else 0.0
        return 3
    if count == 1:
        n = normals[planes[v, 0]]
        axis = 0
        for i in range(1, 3):
            if abs(n[i]) < abs(n[axis]):
                axis = i
        # The coordinate axis most orthogonal to the normal, projected onto the plane.
        for i in range(3):
            basis[0, i] = (1.0 if i == axis else 0.0) - n[axis] * n[i]
        length = np.sqrt(basis[0, 0] ** 2 + basis[0, 1] ** 2 + basis[0, 2] ** 2)
        for i in range(3):
            basis[0, i] /= length
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            basis[1, i] = n[j] * basis[0, k] - n[k] * basis[0, j]
        return 2
    if count == 2:
        n, m = normals[planes[v, 0]], normals[planes[v, 1]]
        length = 0.0
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            basis[0, i] = n[j] * m[k] - n[k] * m[j]
            length += basis[0, i] ** 2
        for i in range(3):
            basis[0, i] /= np.sqrt(length)
        return 1
    return 0


@part(fast=False)
def _solve(matrix, right, size):
    """Solve a small symmetric positive definite system in place; ``right`` becomes the solution."""
    for i in range(size):
        if not matrix[i, i] > 0.0:
            return False
        for j in range(i + 1, size):
            factor = matrix[j, i] / matrix[i, i]
            for k in range(i, size):
                matrix[j, k] -= factor * matrix[i, k]
            right[j] -= factor * right[i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    return True


@part(fast=False)
def place_merged(u, v, kind, mesh, caps, scratch):
    """Write the position of the merged vertex to ``scratch[0]``; return its error.

    The error is infinite where the placement is not allowed.
    """
    points, quadrics = mesh[0], mesh[4]
    planes, locked, normals, offsets = caps
    place, basis, matrix = scratch[0], scratch[1:4], scratch[4:7]
    right = scratch[7]
    u_in_v = not locked[u] and on_planes_of(planes, u, v)
    v_in_u = not locked[v] and on_planes_of(planes, v, u)
    if kind == FIRST or (kind == OPTIMAL and locked[u]):
        if not v_in_u:
            return np.inf
        place[:] = points[u]
    elif kind == SECOND or (kind == OPTIMAL and locked[v]):
        if not u_in_v:
            return np.inf
        place[:] = points[v]
    else:
        if not (u_in_v or v_in_u):
            return np.inf
        base = v if u_in_v else u
        size = _free_directions(planes, normals, base, basis)
        for i in range(3):
            place[i] = points[base, i]
            if size == 3:
                place[i] = 0.5 * (points[u, i] + points[v, i])
        q, r = quadrics[u], quadrics[v]
        for i in range(size):
            x, y, z = basis[i, 0], basis[i, 1], basis[i, 2]
            ax = (q[0] + r[0]) * x + (q[1] + r[1]) * y + (q[2] + r[2]) * z
            ay = (q[1] + r[1]) * x + (q[3] + r[3]) * y + (q[4] + r[4]) * z
            az = (q[2] + r[2]) * x + (q[4] + r[4]) * y + (q[5] + r[5]) * z
            right[i] = x * (q[6] + r[6]) + y * (q[7] + r[7]) + z * (q[8] + r[8])
            right[i] -= ax * place[0] + ay * place[1] + az * place[2]
            for j in range(size):
                matrix[i, j] = ax * basis[j, 0] + ay * basis[j, 1] + az * basis[j, 2]
        if not _solve(matrix, right, size):
            return np.inf
        edge, step = 0.0, 0.0
        for i in range(3):
            edge += (points[u, i] - points[v, i]) ** 2
        for i in range(size):
            step += right[i] ** 2
        # At most one edge length: on a nearly flat patch the optimum is ill-defined.
        share = 1.0 if step <= edge else np.sqrt(edge / step)
        for i in range(size):
            for j in range(3):
                place[j] += share * right[i] * basis[i, j]
        for i in range(len(normals)):
            side = normals[i, 0] * place[0] + normals[i, 1] * place[1] + normals[i, 2] * place[2]
            on_it = planes[base, 0] == i or planes[base, 1] == i or planes[base, 2] == i
            if side > offsets[i] and not on_it:
                return np.inf
    return error_of_both(quadrics, u, v, place[0], place[1], place[2])


# -- Half-edge collapses: a vertex merges into a neighbour, and no vertex moves (numba) -----------
#
# The heap holds vertices with the cost of their cheapest collapse, in three columns: costs,
# vertices, stamps. Changes two edges away may alter that cost without a new entry, so it is
# recomputed when a vertex is popped.
#
# ``bounds`` is the tuple of the square of the greatest length of a new edge, the weight of squared
# length relative to squared height in the cost, the least roundness (height over longest edge) of
# a changed triangle unless it was narrower before, and the least cosine between its normals before
# and after. ``log`` is the tuple of locked (v,) bool (vertices that neither merge nor are merged
# into; all others have all their faces), into (v,) int64 (the vertex that each has merged into),
# level (v,) float64 (the highest cost so far when it merged) and the highest cost so far, (1,)
# float64. The last three are filled.

MAX_RING = 64  # most neighbours of a vertex that can be removed
HEAP_COLUMNS = 2  # integer columns of the heap: vertices and stamps


@part(fast=False)
def _half_edge_shapes_allow(gone, stays, mesh, bounds):
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
        if _half_edge_shapes_allow(vertex, stays, mesh, bounds):
            best, lowest = stays, price
    return best, lowest


@part(fast=False)
def _half_edge_push(vertex, price, stamp, heap, counts):
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
                _half_edge_push(vertex, price, stamps[vertex], heap, counts)


@kernel(fast=False)
def collapse_half_edges(mesh, heap, counts, bounds, log, target, most, budget):
    """Merge the cheapest vertices into neighbours until ``target`` vertices are left.

    No merger costs more than ``most``, and no more than ``budget`` entries are popped.
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
            _half_edge_push(gone, now, stamps[gone], heap, counts)
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
                _half_edge_push(vertex, price, stamps[vertex], heap, counts)
    return PAUSED


# -- Edge collapses with optimal placement, each validated before it is made (numba) --------------
#
# The heap holds edges in six columns: costs, sequence numbers, stamps (the sum of both ends'),
# first and second ends, kinds of placement. If the optimal position is refused, the ends are
# tried.

POINT_WEIGHT = 1e-7
"""Weight of the distance to the vertices relative to the distance to the planes. It makes the
optimum unique on flat patches; 1e-4 would make collapses across a thin plate cheaper than along it.
"""

OPTIMAL_MAX_RING = 48  # most faces around a merged vertex: fans of needles bake and subdivide badly
OPTIMAL_HEAP_COLUMNS = 5  # integer columns of the heap


class Limits(NamedTuple):
    """Bounds on the faces around a collapsed edge."""

    turn_cos: float  # cosine of the largest rotation of a face in one collapse
    fold_cos: float  # cosine of the sharpest new bend between neighbours: -1 is folded back flat
    min_shape: float
    """Least height of a new face over its longest edge, unless the face was narrower before."""


@part(fast=False)
def _optimal_push(u, v, first_kind, mesh, caps, heap, counts, scratch):
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
def _optimal_shapes_allow(u, v, mesh, limits, place, ring, ring_normals):
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
                    _optimal_push(u, v, OPTIMAL, mesh, caps, heap, counts, scratch)


@kernel(fast=False)
def collapse_edges(mesh, caps, heap, counts, limits, scratch, target, budget):
    """Collapse the cheapest edges until ``target`` faces are left or ``budget`` entries popped.

    ``limits``: values of :class:`Limits`; ``scratch``: (8, 3) float64.
    """
    faces, head, following, stamps = mesh[1], mesh[2], mesh[3], mesh[5]
    unused = np.empty(0, np.int64)
    ring = np.empty((OPTIMAL_MAX_RING + 4, 2), np.int64)
    ring_normals = np.empty((OPTIMAL_MAX_RING + 4, 3), np.float64)
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
        if not link_allows(u, v, around, mark, OPTIMAL_MAX_RING, mesh, counts):
            continue
        place_merged(u, v, kind, mesh, caps, scratch)
        size = _optimal_shapes_allow(u, v, mesh, limits, place, ring, ring_normals)
        if size < 0:
            if kind != SECOND:
                _optimal_push(u, v, kind + 1, mesh, caps, heap, counts, scratch)
            continue
        _merge(u, v, mesh, caps, counts, place)
        for i in range(size):
            _optimal_push(u, ring[i, 0], OPTIMAL, mesh, caps, heap, counts, scratch)
    return PAUSED
