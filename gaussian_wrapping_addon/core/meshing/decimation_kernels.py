# SPDX-License-Identifier: GPL-3.0-or-later
"""Edge collapses in the order of their cost, each checked before it is done (numba).

The state is a set of arrays that the kernels change in place, so that a long run can stop and go
on. The corners (3 face + k) of a vertex are linked: ``head[v]`` is its first, ``following[corner]``
the next, -1 ends. Dead faces have -1 as first corner and leave the links when someone walks by. A
quadric is stored as (xx, xy, xz, yy, yz, zz, bx, by, bz, c): the error at p is p'Ap - 2 b'p + c.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from ..compiled import kernel, part

POINT_WEIGHT = 1e-7
"""Weight of the distance to the vertices beside the distance to the planes. A flat patch has a best
point by it; more of it (1e-4) would make collapses across a thin plate cheaper than along it."""

MAX_RING = 48
"""Faces around a merged vertex at most: fans of needles bake and subdivide badly."""

COLUMNS = 10
"""Of a quadric."""

HEAP_SIZE, SEQUENCE, FACES_LEFT, TICK = 0, 1, 2, 3
"""Places in ``counts``, (4,) int64."""

TURN_COS, FOLD_COS, MIN_SHAPE = 0, 1, 2
"""Places in ``limits``, (3,) float64: see :class:`.decimation.Limits`."""

_BEST, _FIRST, _SECOND = 0, 1, 2  # the merged vertex: where the error is least, or one of the ends

DONE, EMPTY, FULL, PAUSED = 0, 1, 2, 3
"""Why :func:`collapse_edges` returned: target reached, nothing left, heap full, budget spent."""


@kernel(fast=False)
def face_quadrics(points, faces, quadrics):
    """Add to the three corners of each face its plane, weighted by area, and the corner itself."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        nx, ny, nz = _normal(points, points[a, 0], points[a, 1], points[a, 2], b, c)
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length <= 0.0:
            continue
        w = 0.5 * length
        e = POINT_WEIGHT * w
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


@kernel(fast=False)
def link_corners(faces, head, following):
    """Fill ``head`` and ``following``; corners of a vertex come in rising order."""
    for f in range(len(faces) - 1, -1, -1):
        if faces[f, 0] < 0:
            continue
        for k in range(2, -1, -1):
            v = faces[f, k]
            following[3 * f + k] = head[v]
            head[v] = 3 * f + k


@part(fast=False)
def _normal(points, x, y, z, b, c):
    """Return twice the area vector of the face with one corner at (x, y, z)."""
    ux, uy, uz = points[b, 0] - x, points[b, 1] - y, points[b, 2] - z
    vx, vy, vz = points[c, 0] - x, points[c, 1] - y, points[c, 2] - z
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@part(fast=False)
def _error(quadrics, u, v, x, y, z):
    """Return the error of both vertices together at a point."""
    q, r = quadrics[u], quadrics[v]
    ax = (q[0] + r[0]) * x + (q[1] + r[1]) * y + (q[2] + r[2]) * z
    ay = (q[1] + r[1]) * x + (q[3] + r[3]) * y + (q[4] + r[4]) * z
    az = (q[2] + r[2]) * x + (q[4] + r[4]) * y + (q[5] + r[5]) * z
    bx, by, bz = q[6] + r[6], q[7] + r[7], q[8] + r[8]
    value = x * (ax - 2.0 * bx) + y * (ay - 2.0 * by) + z * (az - 2.0 * bz) + q[9] + r[9]
    return max(value, 0.0)


@part(fast=False)
def _within(planes, u, v):
    """Tell whether ``v`` lies on every plane that ``u`` lies on."""
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
    """Fill the rows of ``basis`` with directions in which ``v`` may move; return their number."""
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
        # The coordinate axis most across the normal, without its part along the normal.
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
    """Solve a small symmetric positive system in place by elimination; ``right`` is the answer."""
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
def _place(u, v, kind, state, region, work):
    """Put the merged vertex into ``work[0]``; return its error, infinite where it may not go."""
    points, quadrics, planes, locked = state[0], state[4], state[6], state[7]
    normals, offsets = region
    place, basis, matrix = work[0], work[1:4], work[4:7]
    right = work[7]
    u_in_v = not locked[u] and _within(planes, u, v)
    v_in_u = not locked[v] and _within(planes, v, u)
    if kind == _FIRST or (kind == _BEST and locked[u]):
        if not v_in_u:
            return np.inf
        place[:] = points[u]
    elif kind == _SECOND or (kind == _BEST and locked[v]):
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
        # No further than the edge is long: a nearly flat patch does not say where along it.
        share = 1.0 if step <= edge else np.sqrt(edge / step)
        for i in range(size):
            for j in range(3):
                place[j] += share * right[i] * basis[i, j]
        for i in range(len(normals)):
            side = normals[i, 0] * place[0] + normals[i, 1] * place[1] + normals[i, 2] * place[2]
            on_it = planes[base, 0] == i or planes[base, 1] == i or planes[base, 2] == i
            if side > offsets[i] and not on_it:
                return np.inf
    return _error(quadrics, u, v, place[0], place[1], place[2])


@part(fast=False)
def _less(heap, a, b):
    costs, sequences = heap[0], heap[1]
    return costs[a] < costs[b] or (costs[a] == costs[b] and sequences[a] < sequences[b])


@part(fast=False)
def _swap(heap, a, b):
    for column in (heap[1], heap[2], heap[3], heap[4], heap[5]):
        kept = column[a]
        column[a] = column[b]
        column[b] = kept
    cost = heap[0][a]
    heap[0][a] = heap[0][b]
    heap[0][b] = cost


@part(fast=False)
def _push(u, v, first_kind, state, region, heap, counts, work):
    """Put an edge into the heap, where the merged vertex can go anywhere."""
    cost, kind = np.inf, first_kind
    if first_kind == _BEST:
        cost = _place(u, v, _BEST, state, region, work)
    if not cost < np.inf and first_kind != _SECOND:
        cost, kind = _place(u, v, _FIRST, state, region, work), _FIRST
        other = _place(u, v, _SECOND, state, region, work)
        if other < cost:
            # Ends exchanged, so that the cheaper one is always tried first.
            u, v, cost = v, u, other
    elif first_kind == _SECOND:
        cost = _place(u, v, _SECOND, state, region, work)
    if not cost < np.inf:
        return
    slot = counts[HEAP_SIZE]
    heap[0][slot], heap[1][slot] = cost, counts[SEQUENCE]
    heap[2][slot], heap[3][slot] = u, v
    heap[4][slot], heap[5][slot] = state[5][u] + state[5][v], kind
    counts[HEAP_SIZE] += 1
    counts[SEQUENCE] += 1
    while slot > 0 and _less(heap, slot, (slot - 1) // 2):
        _swap(heap, slot, (slot - 1) // 2)
        slot = (slot - 1) // 2


@part(fast=False)
def _drop_first(heap, counts):
    """Remove the cheapest entry."""
    last = counts[HEAP_SIZE] - 1
    _swap(heap, 0, last)
    counts[HEAP_SIZE] = last
    slot = 0
    while True:
        child = 2 * slot + 1
        if child >= last:
            return
        if child + 1 < last and _less(heap, child + 1, child):
            child += 1
        if not _less(heap, child, slot):
            return
        _swap(heap, slot, child)
        slot = child


@part(fast=False)
def _clean(v, faces, head, following):
    """Take dead faces out of the links of ``v``; return the last corner."""
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
def _link_allows(u, v, state, counts):
    """Tell whether the merged surface stays a manifold: the link condition of closed surfaces."""
    faces, head, following, marks = state[1], state[2], state[3], state[8]
    counts[TICK] += 2
    tick = counts[TICK]
    around_u, around_v, shared, common = 0, 0, 0, 0
    corner = head[u]
    while corner >= 0:
        f, k = corner // 3, corner % 3
        b, c = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
        marks[b], marks[c] = tick, tick
        around_u += 1
        if b == v or c == v:
            shared += 1
        corner = following[corner]
    corner = head[v]
    while corner >= 0:
        f, k = corner // 3, corner % 3
        around_v += 1
        for step in range(1, 3):
            w = faces[f, (k + step) % 3]
            if w != u and marks[w] == tick:
                marks[w] = tick + 1
                common += 1
        corner = following[corner]
    if shared != 2 or common != 2 or around_u + around_v - 4 > MAX_RING:
        return False
    return not (around_u == 3 and around_v == 3)  # a tetrahedron


@part(fast=False)
def _across(b, c, state, skip_u, skip_v):
    """Return the face on the other side of the half-edge b -> c that holds neither end, or -1."""
    faces, head, following = state[1], state[2], state[3]
    corner = head[b]
    while corner >= 0:
        f, k = corner // 3, corner % 3
        if faces[f, 0] >= 0 and faces[f, (k + 2) % 3] == c:
            apex = faces[f, (k + 1) % 3]
            return -1 if apex in (skip_u, skip_v) else f
        corner = following[corner]
    return -1


@part(fast=False)
def _shape_allows(u, v, state, limits, place, ring, ring_normals):
    """Tell whether no face turns over, folds back onto a neighbour, or becomes a needle.

    ``ring`` and ``ring_normals`` are filled with the outer edges and new unit normals of the faces
    that stay.
    """
    points, faces, head, following = state[0], state[1], state[2], state[3]
    x, y, z = place[0], place[1], place[2]
    size = 0
    for turn in range(2):
        centre, other = (u, v) if turn == 0 else (v, u)
        corner = head[centre]
        while corner >= 0:
            f, k = corner // 3, corner % 3
            corner = following[corner]
            b, c = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            if b == other or c == other:
                continue
            ox, oy, oz = _normal(
                points, points[centre, 0], points[centre, 1], points[centre, 2], b, c
            )
            nx, ny, nz = _normal(points, x, y, z, b, c)
            old, new = np.sqrt(ox * ox + oy * oy + oz * oz), np.sqrt(nx * nx + ny * ny + nz * nz)
            if not new > 0.0:
                return -1
            if nx * ox + ny * oy + nz * oz < limits[TURN_COS] * new * old:
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
            if new < limits[MIN_SHAPE] * new_long and new * old_long < old * new_long:
                return -1
            ring[size, 0], ring[size, 1] = b, c
            ring_normals[size, 0], ring_normals[size, 1] = nx / new, ny / new
            ring_normals[size, 2] = nz / new
            beyond = _across(b, c, state, u, v)
            if beyond >= 0:
                a = faces[beyond, 0]
                mx, my, mz = _normal(
                    points, points[a, 0], points[a, 1], points[a, 2],
                    faces[beyond, 1], faces[beyond, 2],
                )  # fmt: skip
                length = np.sqrt(mx * mx + my * my + mz * mz)
                bend = (nx * mx + ny * my + nz * mz) * old
                before = (ox * mx + oy * my + oz * mz) * new
                if bend < limits[FOLD_COS] * new * old * length and bend < before:
                    return -1
            size += 1
    for i in range(size):
        for j in range(size):
            if ring[j, 0] == ring[i, 1]:
                bend = 0.0
                for k in range(3):
                    bend += ring_normals[i, k] * ring_normals[j, k]
                if bend < limits[FOLD_COS]:
                    return -1
    return size


@part(fast=False)
def _merge(u, v, state, counts, place):
    """Let ``v`` become ``u``, at ``place``."""
    points, faces, head, following, quadrics, stamps, planes, locked, _ = state
    corner = head[v]
    while corner >= 0:
        f, k = corner // 3, corner % 3
        if faces[f, (k + 1) % 3] == u or faces[f, (k + 2) % 3] == u:
            faces[f, 0] = -1
            counts[FACES_LEFT] -= 1
        else:
            faces[f, k] = u
        corner = following[corner]
    last = _clean(u, faces, head, following)
    if last < 0:
        head[u] = head[v]
    else:
        following[last] = head[v]
    head[v] = -1
    _clean(u, faces, head, following)
    if not _within(planes, v, u):
        planes[u] = planes[v]
    points[u] = place
    quadrics[u] += quadrics[v]
    locked[u] = locked[u] or locked[v]
    stamps[u] += 1
    stamps[v] += 1


@kernel(fast=False)
def push_edges(state, region, heap, counts, work):
    """Put every edge into the empty heap, which must have room for half of all corners."""
    faces = state[1]
    for f in range(len(faces)):
        if faces[f, 0] >= 0:
            for k in range(3):
                u, v = faces[f, k], faces[f, (k + 1) % 3]
                if u < v:
                    _push(u, v, _BEST, state, region, heap, counts, work)


@kernel(fast=False)
def collapse_edges(state, region, heap, counts, limits, work, target, budget):
    """Collapse the cheapest edges until ``target`` faces are left; see the constants returned.

    Parameters
    ----------
    state : tuple
        points (v, 3) float64, faces (f, 3) int64, head (v,) int64, following (3f,) int64,
        quadrics (v, 10) float64, stamps (v,) int64, planes (v, 3) int64 (-1: none), locked (v,)
        bool, marks (v,) int64.
    region : tuple
        normals (k, 3) and offsets (k,) float64: inside is ``normal . x <= offset``.
    heap : tuple
        costs float64, sequences, firsts, seconds, stamps, kinds int64.
    counts, limits : array
        See :data:`HEAP_SIZE` and :data:`TURN_COS`.
    work : (8, 3) float64
        Scratch.
    budget : int
        Entries looked at.
    """
    faces, head, following, stamps = state[1], state[2], state[3], state[5]
    ring = np.empty((MAX_RING + 4, 2), np.int64)
    ring_normals = np.empty((MAX_RING + 4, 3), np.float64)
    place = work[0]
    room = len(heap[0]) - 2 * MAX_RING
    for _ in range(budget):
        if counts[FACES_LEFT] <= target:
            return DONE
        if counts[HEAP_SIZE] == 0:
            return EMPTY
        if counts[HEAP_SIZE] > room:
            return FULL
        u, v, kind = heap[2][0], heap[3][0], heap[5][0]
        current = stamps[u] + stamps[v] == heap[4][0]
        _drop_first(heap, counts)
        if not current or head[u] < 0 or head[v] < 0:
            continue
        _clean(u, faces, head, following)
        _clean(v, faces, head, following)
        if not _link_allows(u, v, state, counts):
            continue
        _place(u, v, kind, state, region, work)
        size = _shape_allows(u, v, state, limits, place, ring, ring_normals)
        if size < 0:
            if kind != _SECOND:
                _push(u, v, kind + 1, state, region, heap, counts, work)
            continue
        _merge(u, v, state, counts, place)
        for i in range(size):
            _push(u, ring[i, 0], _BEST, state, region, heap, counts, work)
    return PAUSED
