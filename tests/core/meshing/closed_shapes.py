# SPDX-License-Identifier: GPL-3.0-or-later
"""Closed meshes of known shapes, fine and uneven enough to be decimated and smoothed."""

from __future__ import annotations

import numpy as np
import trimesh

Mesh = tuple[np.ndarray, np.ndarray]


def _plain(mesh: trimesh.Trimesh) -> Mesh:
    return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)


def ball(subdivisions: int = 4) -> Mesh:
    return _plain(trimesh.creation.icosphere(subdivisions=subdivisions))


def ring(around: int = 120, across: int = 40) -> Mesh:
    """A torus of radii 1 and 0.3."""
    return _plain(trimesh.creation.torus(1.0, 0.3, major_sections=around, minor_sections=across))


def slab(half: tuple[float, float, float], edge: float) -> Mesh:
    """A box with faces no longer than ``edge``, its sharp edges straight."""
    mesh = trimesh.creation.box(2 * np.array(half))
    return _plain(mesh.subdivide_to_size(edge)) if edge > 0 else _plain(mesh)


def wire(length: float = 2.0, radius: float = 0.02, rings: int = 150, sides: int = 5) -> Mesh:
    """A thin closed tube along x: two end points and rings between."""
    x = np.linspace(-length / 2, length / 2, rings)
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = radius * np.stack([np.zeros(sides), np.cos(angle), np.sin(angle)], 1)
    body = x[:, None, None] * np.array([1.0, 0, 0]) + circle  # (rings, sides, 3)
    ends = np.array([[-length / 2 - radius, 0, 0], [length / 2 + radius, 0, 0]])
    vertices = np.concatenate([body.reshape(-1, 3), ends])
    faces = []
    for i in range(rings - 1):
        for j in range(sides):
            a, b = i * sides + j, i * sides + (j + 1) % sides
            faces += [[a, b, b + sides], [a, b + sides, a + sides]]
    first, last = len(vertices) - 2, len(vertices) - 1
    for j in range(sides):
        k = (j + 1) % sides
        faces += [[first, k, j], [last, (rings - 1) * sides + j, (rings - 1) * sides + k]]
    result = np.array(faces)
    corners = vertices[result]
    volume = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum()
    return vertices, result if volume > 0 else result[:, ::-1].copy()


def lattice(bars: int = 3, edge: float = 0.12) -> Mesh:
    """A grid of square bars in a plane: genus ``bars**2``, made of unit cells."""
    size = 2 * bars + 1
    cells = [(x, y, 0) for x in range(size) for y in range(size) if x % 2 == 0 or y % 2 == 0]
    from tests.core.meshing.test_repair import cubes

    vertices, faces = cubes(*cells)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return _plain(mesh.subdivide().subdivide() if edge < 0.3 else mesh)


def noisy(mesh: Mesh, amount: float, seed: int = 0) -> Mesh:
    """Move every vertex by a normal deviate."""
    rng = np.random.default_rng(seed)
    return mesh[0] + amount * rng.normal(size=mesh[0].shape), mesh[1]


def joined(*meshes: Mesh) -> Mesh:
    """Put meshes into one, unconnected."""
    starts = np.cumsum([0, *(len(m[0]) for m in meshes)])
    faces = [m[1] + start for m, start in zip(meshes, starts, strict=False)]
    return np.concatenate([m[0] for m in meshes]), np.concatenate(faces)


def sharpest_bend_cos(mesh: Mesh) -> float:
    """Return the least cosine between the normals of neighbouring faces, of a closed mesh."""
    tri = trimesh.Trimesh(*mesh, process=False)
    pairs = tri.face_adjacency
    normals = np.cross(
        mesh[0][mesh[1][:, 1]] - mesh[0][mesh[1][:, 0]],
        mesh[0][mesh[1][:, 2]] - mesh[0][mesh[1][:, 0]],
    )
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return float((normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(1).min())
