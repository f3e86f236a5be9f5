# SPDX-License-Identifier: GPL-3.0-or-later
"""Which vertices of a dense closed mesh a coarser one keeps: those that its shape needs.

Density alone cannot follow a surface that curves one way only (a wire, a fold): long triangles
along it would do. Removing vertices one by one, the cheapest first, finds both the places and the
directions in which edges may be long. No vertex moves, so all stay on the isosurface.
"""

from __future__ import annotations

import heapq

import numpy as np

from ..compiled import kernel, part

SHAPE_WEIGHT = 1e-6
"""Price of length beside that of height, both squared: it decides where the surface is flat."""

LEAST_ROUNDNESS = 0.03
"""Height over the longest edge that a changed triangle must keep, unless it was narrower."""

LEAST_COSINE = 0.3
"""Between normals of a triangle before and after a change."""

MAX_RING = 64
"""Neighbours of a vertex at most; a vertex with more stays."""

_PLANE = 10
"""Columns of a quadric: xx xy xz xw yy yz yw zz zw ww of the plane (x, y, z, w)."""


def select_vertices(
    vertices: np.ndarray, faces: np.ndarray, target: int, longest: float
) -> np.ndarray:
    """Collapse edges onto one of their ends until ``target`` vertices are left.

    The price of a vertex is the sum of squared distances from the vertex that replaces it to the
    planes of all faces that it has stood for, by area (quadric error). A closed 2-manifold stays
    one, with the same genus and parts; no face turns over or becomes narrow.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
        A closed 2-manifold, every vertex used.
    target : int
        Number of vertices; more stay where no vertex can go.
    longest : float
        No edge becomes longer.

    Returns
    -------
    (g, 3) int64
        Faces over the same vertices, most of which are unused.
    """
    if len(vertices) <= target:
        return np.asarray(faces, np.int64)
    low, high = vertices.min(0), vertices.max(0)
    unit = float((high - low).max())
    local = np.ascontiguousarray((vertices - (low + high) / 2) / unit)
    result = np.ascontiguousarray(faces, np.int64).copy()
    alive = _select_kernel(
        local, result, target, (longest / unit) ** 2, SHAPE_WEIGHT, LEAST_ROUNDNESS, LEAST_COSINE
    )
    return result[alive]


@part(fast=False)
def _ring(vertex, faces, head, following, alive, out):  # type: ignore[no-untyped-def]
    """Neighbours of a vertex of a closed manifold, each once; -1 where there are too many."""
    count = 0
    corner = head[vertex]
    while corner >= 0:
        face = corner // 3
        if alive[face]:
            if count >= MAX_RING:
                return -1
            # Around a vertex of a closed manifold each neighbour follows it in exactly one face.
            out[count] = faces[face, (corner - 3 * face + 1) % 3]
            count += 1
        corner = following[corner]
    return count


@part(fast=False)
def _price(quadrics, vertex, points, at):  # type: ignore[no-untyped-def]
    x, y, z = points[at, 0], points[at, 1], points[at, 2]
    q = quadrics[vertex]
    return (
        x * (q[0] * x + 2.0 * (q[1] * y + q[2] * z + q[3]))
        + y * (q[4] * y + 2.0 * (q[5] * z + q[6]))
        + z * (q[7] * z + 2.0 * q[8])
        + q[9]
    )


@part(fast=False)
def _may_go(  # type: ignore[no-untyped-def]
    gone, stays, points, faces, head, following, alive, ring, count, other, longest, least, cosine
):
    """Tell whether ``gone`` may merge into ``stays``: link condition and shapes of the faces."""
    others = _ring(stays, faces, head, following, alive, other)
    if others < 0 or count + others - 4 > MAX_RING:
        return False
    common = 0
    for i in range(count):
        for j in range(others):
            if ring[i] == other[j]:
                common += 1
    if common != 2 or count + others <= 6:
        return False
    corner = head[gone]
    while corner >= 0:
        face = corner // 3
        if alive[face]:
            k = corner - 3 * face
            b, c = faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
            if b != stays and c != stays:
                ex, ey, ez = (
                    points[c, 0] - points[b, 0], points[c, 1] - points[b, 1],
                    points[c, 2] - points[b, 2],
                )  # fmt: skip
                ux, uy, uz = (
                    points[gone, 0] - points[b, 0], points[gone, 1] - points[b, 1],
                    points[gone, 2] - points[b, 2],
                )  # fmt: skip
                wx, wy, wz = (
                    points[stays, 0] - points[b, 0], points[stays, 1] - points[b, 1],
                    points[stays, 2] - points[b, 2],
                )  # fmt: skip
                nx, ny, nz = ey * uz - ez * uy, ez * ux - ex * uz, ex * uy - ey * ux
                mx, my, mz = ey * wz - ez * wy, ez * wx - ex * wz, ex * wy - ey * wx
                before = np.sqrt(nx * nx + ny * ny + nz * nz)
                after = np.sqrt(mx * mx + my * my + mz * mz)
                if not (nx * mx + ny * my + nz * mz > cosine * before * after):
                    return False
                side = ex * ex + ey * ey + ez * ez
                old = max(side, ux * ux + uy * uy + uz * uz)
                old = max(old, (ux - ex) ** 2 + (uy - ey) ** 2 + (uz - ez) ** 2)
                first = wx * wx + wy * wy + wz * wz
                second = (wx - ex) ** 2 + (wy - ey) ** 2 + (wz - ez) ** 2
                if first > longest or second > longest:
                    return False
                new = max(side, first, second)
                # Roundness is twice the area over the longest edge squared.
                if after < min(least * new, before / old * new):
                    return False
        corner = following[corner]
    return True


@part(fast=False)
def _best(  # type: ignore[no-untyped-def]
    vertex, points, faces, head, following, alive, quadrics, areas, ring, other, longest, weight,
    least, cosine,
):  # fmt: skip
    """Cheapest vertex that may replace this one, and the price; (-1, inf) without one."""
    best, lowest = -1, np.inf
    count = _ring(vertex, faces, head, following, alive, ring)
    for i in range(count):
        stays = ring[i]
        square = 0.0
        for k in range(3):
            square += (points[vertex, k] - points[stays, k]) ** 2
        price = max(_price(quadrics, vertex, points, stays), 0.0) + weight * areas[vertex] * square
        # Equal prices by number, so that the order of the faces does not matter.
        if price > lowest or (price == lowest and stays > best):
            continue
        if _may_go(
            vertex, stays, points, faces, head, following, alive, ring, count, other, longest,
            least, cosine,
        ):  # fmt: skip
            best, lowest = stays, price
    return best, lowest


@kernel(fast=False)
def _select_kernel(  # type: ignore[no-untyped-def]
    points, faces, target, longest, weight, least, cosine
):
    count = len(points)
    alive = np.ones(len(faces), np.bool_)
    head = np.full(count, -1, np.int64)
    tail = np.full(count, -1, np.int64)
    following = np.full(3 * len(faces), -1, np.int64)
    quadrics = np.zeros((count, _PLANE))
    areas = np.zeros(count)
    plane = np.empty(4)
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ux, wx = points[b, 0] - points[a, 0], points[c, 0] - points[a, 0]
        uy, wy = points[b, 1] - points[a, 1], points[c, 1] - points[a, 1]
        uz, wz = points[b, 2] - points[a, 2], points[c, 2] - points[a, 2]
        plane[0], plane[1], plane[2] = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        area = np.sqrt(plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2)
        if area > 0.0:
            for k in range(3):
                plane[k] /= area
        plane[3] = -(plane[0] * points[a, 0] + plane[1] * points[a, 1] + plane[2] * points[a, 2])
        for k in range(3):
            vertex = faces[face, k]
            corner = 3 * face + k
            following[corner] = head[vertex]
            if head[vertex] < 0:
                tail[vertex] = corner
            head[vertex] = corner
            areas[vertex] += area
            column = 0
            for i in range(4):
                for j in range(i, 4):
                    quadrics[vertex, column] += area * plane[i] * plane[j]
                    column += 1
    ring, other = np.empty(MAX_RING, np.int64), np.empty(MAX_RING, np.int64)
    around = np.empty(MAX_RING, np.int64)
    version = np.zeros(count, np.int64)
    heap = [(np.inf, np.int64(0), np.int64(-1))]
    left = count
    for vertex in range(count):
        if head[vertex] < 0:
            left -= 1
            continue
        best, price = _best(
            vertex, points, faces, head, following, alive, quadrics, areas, ring, other, longest,
            weight, least, cosine,
        )  # fmt: skip
        if best >= 0:
            heap.append((price, np.int64(vertex), np.int64(0)))
    heapq.heapify(heap)
    while left > target:
        price, gone, born = heapq.heappop(heap)
        if born < 0:
            break
        if version[gone] != born:
            continue
        # What lies two edges away may have changed since.
        stays, now = _best(
            gone, points, faces, head, following, alive, quadrics, areas, ring, other, longest,
            weight, least, cosine,
        )  # fmt: skip
        if stays < 0:
            continue
        if now > price:
            version[gone] += 1
            heapq.heappush(heap, (now, gone, version[gone]))
            continue
        corner = head[gone]
        while corner >= 0:
            face = corner // 3
            if alive[face]:
                if faces[face, 0] == stays or faces[face, 1] == stays or faces[face, 2] == stays:
                    alive[face] = False
                else:
                    faces[face, corner - 3 * face] = stays
            corner = following[corner]
        following[tail[stays]] = head[gone]
        tail[stays] = tail[gone]
        version[gone] = -2
        left -= 1
        for k in range(_PLANE):
            quadrics[stays, k] += quadrics[gone, k]
        areas[stays] += areas[gone]
        # Dead corners leave the list, or it would grow at vertices that many merge into.
        previous = np.int64(-1)
        corner = head[stays]
        while corner >= 0:
            if alive[corner // 3]:
                if previous < 0:
                    head[stays] = corner
                else:
                    following[previous] = corner
                previous = corner
            corner = following[corner]
        following[previous] = -1
        tail[stays] = previous
        near = _ring(stays, faces, head, following, alive, around)
        for slot in range(near + 1):
            vertex = around[slot] if slot < near else stays
            version[vertex] += 1
            best, price = _best(
                vertex, points, faces, head, following, alive, quadrics, areas, ring, other,
                longest, weight, least, cosine,
            )  # fmt: skip
            if best >= 0:
                heapq.heappush(heap, (price, np.int64(vertex), version[vertex]))
    return alive
