# SPDX-License-Identifier: GPL-3.0-or-later
"""Quadric error metrics: area-weighted squared distances to planes (numba).

Garland and Heckbert, "Surface simplification using quadric error metrics" (1997). A quadric is
stored as (xx, xy, xz, yy, yz, zz, bx, by, bz, c, w): the error at p is p'Ap - 2 b'p + c, and w is
the total weight of the planes. Each collapse strategy evaluates it in its own order of operations,
on which its results depend in the last digits.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from ...kernels.compiled import kernel, part

COLUMNS = 11
"""Columns of a quadric."""

WEIGHT = 10
"""Column of the planes' total weight."""


@kernel(fast=False)
def add_face_quadrics(points, faces, quadrics, scale, point_weight):
    """Add the plane of each face to the quadrics of its three corners.

    Parameters
    ----------
    points : (v, 3) float64
    faces : (f, 3) int64
    quadrics : (v, 11) float64
        Modified in place.
    scale : float
        Weight of a plane per length of the area vector, which is twice the area.
    point_weight : float
        Weight of the squared distance to the corner itself relative to that of the plane.
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
