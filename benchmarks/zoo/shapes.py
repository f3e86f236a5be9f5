# SPDX-License-Identifier: GPL-3.0-or-later
"""Closed solids that the families are made of, beside those of :mod:`benchmarks.scenes`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..scenes.geometry import Part, icosphere

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (v, 3) float64 and outward faces (f, 3) int32."""


def _grid_faces(rows: int, columns: int, *, closed_rows: bool) -> np.ndarray:
    """Return faces (f, 3) of a grid of vertices whose columns go around."""
    ids = np.arange(rows * columns).reshape(rows, columns)
    a = ids if closed_rows else ids[:-1]
    b = np.roll(ids, -1, 0) if closed_rows else ids[1:]
    c, d = np.roll(b, -1, 1), np.roll(a, -1, 1)
    quads = np.stack([a, b, c, d], -1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def turned(mesh: Mesh, matrix: np.ndarray, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
    """Return the mesh times a rotation (3, 3), then moved."""
    return mesh[0] @ np.asarray(matrix).T + np.asarray(offset, np.float64), mesh[1]


def rotation(random: np.random.Generator) -> np.ndarray:
    """Draw a rotation (3, 3), uniformly."""
    q, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def about(axis: str, degrees: float) -> np.ndarray:
    """Return the rotation (3, 3) about a coordinate axis."""
    k = "xyz".index(axis)
    i, j = (k + 1) % 3, (k + 2) % 3
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def tube(line: np.ndarray, radius: float, sides: int = 10, *, closed: bool = False) -> Mesh:
    """Return a tube around a polyline (n, 3) that bends gently; ``closed`` joins its ends.

    Open ends are capped flat. Frames are carried along the line; on a closed line the twist that
    is left over is spread evenly.
    """
    count = len(line)
    following = np.roll(line, -1, 0) - np.roll(line, 1, 0)
    if not closed:
        following[0], following[-1] = line[1] - line[0], line[-1] - line[-2]
    tangent = following / np.linalg.norm(following, axis=1, keepdims=True)
    u = np.empty_like(line)
    u[0] = np.cross(tangent[0], [1.0, 0, 0] if abs(tangent[0, 0]) < 0.9 else [0, 1.0, 0])
    for k in range(1, count):
        u[k] = u[k - 1] - (u[k - 1] @ tangent[k]) * tangent[k]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(tangent, u)
    angle = np.broadcast_to(2 * np.pi * np.arange(sides) / sides, (count, sides)).copy()
    if closed:
        carried = u[-1] - (u[-1] @ tangent[0]) * tangent[0]
        twist = np.arctan2(carried @ v[0], carried @ u[0])
        angle -= twist * (np.arange(count) / count)[:, None]
    ring = np.cos(angle)[..., None] * u[:, None] + np.sin(angle)[..., None] * v[:, None]
    vertices = (line[:, None] + radius * ring).reshape(-1, 3)
    faces = _grid_faces(count, sides, closed_rows=closed)[:, ::-1]
    if not closed:
        ends = len(vertices) + np.arange(2)
        first, last = np.arange(sides), (count - 1) * sides + np.arange(sides)
        caps = [
            np.stack([np.full(sides, ends[0]), np.roll(first, -1), first], 1),
            np.stack([np.full(sides, ends[1]), last, np.roll(last, -1)], 1),
        ]
        vertices = np.concatenate([vertices, line[[0, -1]]])
        faces = np.concatenate([faces, *caps])
    return vertices, faces.astype(np.int32)


def ring(radius: float, thickness: float, steps: int = 72, sides: int = 12) -> Mesh:
    """Return a torus around the z axis; ``thickness`` is the tube's radius."""
    angle = 2 * np.pi * np.arange(steps) / steps
    line = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(steps)], 1)
    return tube(line, thickness, sides, closed=True)


def lathe(profile: np.ndarray, sides: int = 72) -> Mesh:
    """Return the solid of revolution about z of a profile (n, 2) of radius and height.

    The profile goes counter-clockwise (radius to the right, height up) from the axis to the axis:
    its first and last radius are 0.
    """
    inner = profile[1:-1]
    angle = 2 * np.pi * np.arange(sides) / sides
    around = np.stack([np.cos(angle), np.sin(angle)], 1)  # (sides, 2)
    rows = np.concatenate(
        [
            inner[:, None, :1] * around,
            np.broadcast_to(inner[:, None, 1:], (*inner.shape[:1], sides, 1)),
        ],
        2,
    )
    count = len(inner)
    ends = count * sides + np.arange(2)
    first, last = np.arange(sides), (count - 1) * sides + np.arange(sides)
    faces = np.concatenate(
        [
            _grid_faces(count, sides, closed_rows=False)[:, ::-1],
            np.stack([np.full(sides, ends[0]), np.roll(first, -1), first], 1),
            np.stack([np.full(sides, ends[1]), last, np.roll(last, -1)], 1),
        ]
    )
    poles = [[0.0, 0.0, profile[0, 1]], [0.0, 0.0, profile[-1, 1]]]
    return np.concatenate([rows.reshape(-1, 3), poles]), faces.astype(np.int32)


def blob(random: np.random.Generator, bumps: int, amount: float, subdivisions: int = 5) -> Mesh:
    """Return a smooth star-shaped body of radius about 1 with so many random waves."""
    directions, faces = icosphere(subdivisions)
    radius = np.ones(len(directions))
    for _ in range(bumps):
        wave = random.normal(size=3) * random.uniform(1.0, 3.2)
        radius += amount / np.sqrt(bumps) * np.sin(directions @ wave + random.uniform(0, 6.28))
    return directions * np.maximum(radius, 0.3)[:, None], faces


def metaballs(random: np.random.Generator, count: int, subdivisions: int = 5) -> Mesh:
    """Return the level set of a sum of round bells, as far as it is star-shaped from 0."""
    centers = random.normal(size=(count, 3))
    centers *= (random.uniform(0.35, 0.75, count) / np.linalg.norm(centers, axis=1))[:, None]
    centers[0] = 0.0
    widths = random.uniform(0.28, 0.42, count)
    directions, faces = icosphere(subdivisions)
    low, high = np.zeros(len(directions)), np.full(len(directions), 2.5)

    def bells(radius: np.ndarray) -> np.ndarray:
        away = (radius[:, None] * directions)[:, None] - centers  # (v, c, 3)
        return np.exp(-((away**2).sum(-1)) / (2 * widths**2)).sum(1)

    steps = np.linspace(0.0, 2.5, 60)
    outer = np.zeros(len(directions))
    for step in steps:  # the first time that the level is left
        inside = bells(np.full(len(directions), step)) > 0.45
        outer = np.where(inside & (outer >= step - steps[1] * 1.01), step, outer)
    low, high = outer, outer + steps[1]
    for _ in range(30):
        middle = (low + high) / 2
        inside = bells(middle) > 0.45
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return directions * low[:, None], faces


def blocks(xs: np.ndarray, ys: np.ndarray, zs: np.ndarray, filled: np.ndarray) -> Mesh:
    """Return the surface of the filled cells of a grid with such planes.

    Parameters
    ----------
    xs, ys, zs : (n,) float64
        Planes, ascending.
    filled : (len(xs) - 1, len(ys) - 1, len(zs) - 1) bool
        Filled cells must not touch along an edge or at a corner only.
    """
    padded = np.pad(filled, 1)
    shape = np.array([len(xs), len(ys), len(zs)])
    quads = []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            neighbour = np.roll(padded, 1 - 2 * side, axis)[1:-1, 1:-1, 1:-1]
            cells = np.argwhere(filled & ~neighbour)
            corners = np.repeat(cells[:, None], 4, 1)  # (q, 4, 3)
            corners[:, :, axis] += side
            corners[:, [1, 2], i] += 1
            corners[:, [2, 3], j] += 1
            quads.append(corners if side else corners[:, ::-1])
    every = np.concatenate(quads)
    ids = np.ravel_multi_index(tuple(every.reshape(-1, 3).T), tuple(shape)).reshape(-1, 4)
    used, inverse = np.unique(ids, return_inverse=True)
    at = np.stack(np.unravel_index(used, tuple(shape)), 1)
    vertices = np.stack([np.asarray(p)[at[:, k]] for k, p in enumerate((xs, ys, zs))], 1)
    inverse = inverse.reshape(-1, 4)
    faces = np.concatenate([inverse[:, [0, 1, 2]], inverse[:, [0, 2, 3]]])
    return vertices.astype(np.float64), faces.astype(np.int32)


def perforated(columns: int, rows: int, cell: float, hole: float, thickness: float) -> Mesh:
    """Return an upright plate (in xz) of square cells with a round hole in each.

    Parameters
    ----------
    cell, hole, thickness : float
        Side of a cell, diameter of its hole, thickness along y.
    """
    step = np.radians(22.5 + 45.0 * np.arange(8))
    circle = 0.5 * hole * np.stack([np.cos(step), np.sin(step)], 1) / np.cos(np.radians(22.5))
    finer = [circle[k] + t * (circle[(k + 1) % 8] - circle[k]) for k in range(8) for t in (0, 0.5)]
    inner = np.array(finer)
    inner *= (0.5 * hole / np.linalg.norm(inner, axis=1))[:, None]  # (16, 2) on the circle
    outer = inner / np.abs(inner).max(1, keepdims=True) * 0.5 * cell
    corner = np.abs(np.abs(outer[:, 0]) - np.abs(outer[:, 1])) < 1e-9
    outer[corner] = np.sign(outer[corner]) * 0.5 * cell
    sheets, quads, sides = [], [], []
    for column in range(columns):
        for row in range(rows):
            middle = cell * np.array([column - (columns - 1) / 2, row - (rows - 1) / 2])
            base = 32 * (column * rows + row)
            sheets.append(np.concatenate([outer, inner]) + middle)
            for k in range(16):
                n = (k + 1) % 16
                quads.append((base + k, base + n, base + 16 + n, base + 16 + k))
                sides.append((base + 16 + n, base + 16 + k))
                x, z = (outer[k] + outer[n]) / 2
                rim = (x > 0.499 * cell and column == columns - 1) or (
                    x < -0.499 * cell and column == 0
                )
                rim |= (z > 0.499 * cell and row == rows - 1) or (z < -0.499 * cell and row == 0)
                if rim:
                    sides.append((base + k, base + n))
    flat, quad = np.concatenate(sheets), np.array(quads)
    _, first, same = np.unique(
        np.round(flat / cell, 6), axis=0, return_index=True, return_inverse=True
    )
    flat, quad, edge = flat[first], same.reshape(-1)[quad], same.reshape(-1)[np.array(sides)]
    count = len(flat)
    front = np.stack([flat[:, 0], np.full(count, -thickness / 2), flat[:, 1]], 1)
    back = front + np.array([0.0, thickness, 0.0])
    walls = np.stack([edge[:, 0], edge[:, 0] + count, edge[:, 1] + count, edge[:, 1]], 1)
    every = np.concatenate([quad, quad[:, ::-1] + count, walls])
    faces = np.concatenate([every[:, [0, 1, 2]], every[:, [0, 2, 3]]])
    return np.concatenate([front, back]), faces.astype(np.int32)


def leaf(length: float, width: float, bend: float, thickness: float, steps: int = 9) -> Mesh:
    """Return a bent leaf from the origin along x, its upper side towards z: a thin closed plate."""
    t = np.linspace(0.02, 1.0, steps)
    half = 0.5 * width * np.sin(np.pi * np.minimum(t, 0.985)) ** 0.8 + 0.02 * width
    across = np.linspace(-1.0, 1.0, 5)
    x = np.broadcast_to(t[:, None] * length, (steps, 5))
    y = half[:, None] * across
    z = bend * length * t[:, None] ** 2 + 0.25 * np.abs(y)
    middle = np.stack([x, y, np.broadcast_to(z, x.shape)], -1).reshape(-1, 3)
    ids = np.arange(5 * steps).reshape(steps, 5)
    a, b, c, d = ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]
    quads = np.stack([a, b, c, d], -1).reshape(-1, 4)
    count = len(middle)
    rim = np.concatenate([ids[:, 0], ids[-1, 1:], ids[::-1, -1][1:], ids[0, ::-1][1:-1]])
    following = np.roll(rim, -1)
    walls = np.stack([rim, rim + count, following + count, following], 1)
    every = np.concatenate([quads, quads[:, ::-1] + count, walls])
    faces = np.concatenate([every[:, [0, 1, 2]], every[:, [0, 2, 3]]])
    lift = np.array([0.0, 0.0, thickness / 2])
    return np.concatenate([middle + lift, middle - lift]), faces.astype(np.int32)


def part(name: str, mesh: Mesh, material: str, *, smooth: bool = True) -> Part:
    """Return a mesh as a part of a scene."""
    return Part(name, mesh[0], mesh[1], material, smooth=smooth)
