# SPDX-License-Identifier: GPL-3.0-or-later
"""Optimal position of a merged vertex: least error on the planes of its ends (numba).

``caps`` is the tuple of planes (v, 3) int64 that each vertex lies on (-1: none), locked (v,) bool,
normals (k, 3) and offsets (k,) float64: inside is ``normal . x <= offset``.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from ...kernels.compiled import part
from .quadrics import error_of_both

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

    Returns
    -------
    Number of directions.
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
