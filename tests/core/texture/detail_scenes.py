# SPDX-License-Identifier: GPL-3.0-or-later
"""Analytic meshes with detail: a bumpy ball, sheets, and a light mesh with a simple atlas."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh

BUMPS = 18.0
"""Radians along a unit: about 20 bumps around the equator."""


def cube_sphere(pieces: int) -> SurfaceMesh:
    """A closed unit ball of 12 ``pieces``^2 faces of nearly even size."""
    grid = np.linspace(-1.0, 1.0, pieces + 1)
    a, b = np.meshgrid(grid, grid, indexing="ij")
    number = np.arange((pieces + 1) ** 2).reshape(pieces + 1, pieces + 1)
    quad = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1)
    points, quads = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            quads.append(quad.reshape(-1, 4) + len(points) * number.size)
            place = np.empty((*number.shape, 3))
            place[..., axis] = side
            place[..., (axis + 1) % 3] = side * a
            place[..., (axis + 2) % 3] = b
            points.append(place.reshape(-1, 3))
    every = np.concatenate(points)
    _, first, index = np.unique(
        np.round(every * 1e6).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    corners = index.ravel()[np.concatenate(quads)]
    vertices = np.tan(every[first] * np.pi / 4)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return SurfaceMesh(vertices, faces.astype(np.int32))


def bumpy_radius(directions: np.ndarray, height: float) -> np.ndarray:
    """(n, 1) radius of the bumpy ball in (n, 3) unit directions."""
    waves = np.sin(BUMPS * directions + np.arange(3.0))
    return 1.0 + height * waves.prod(axis=1, keepdims=True)


def bumpy_ball(pieces: int, height: float = 0.03) -> SurfaceMesh:
    ball = cube_sphere(pieces)
    return SurfaceMesh(ball.vertices * bumpy_radius(ball.vertices, height), ball.faces)


def bumpy_normals(points: np.ndarray, height: float = 0.03) -> np.ndarray:
    """True (n, 3) unit normals of the bumpy ball below points near it."""
    radius = np.linalg.norm(points, axis=1, keepdims=True)
    way = points / radius
    phase = BUMPS * way + np.arange(3.0)
    sine, cosine = np.sin(phase), np.cos(phase)
    slope = np.stack(
        [cosine[:, k] * sine[:, (k + 1) % 3] * sine[:, (k + 2) % 3] for k in range(3)], axis=1
    )
    slope *= height * BUMPS  # of the radius, by the direction
    slope -= (slope * way).sum(axis=1, keepdims=True) * way
    normals = way - slope / bumpy_radius(way, height)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def grid(pieces: int, height=None, *, side: float = 1.0, z: float = 0.0) -> SurfaceMesh:
    """A square sheet around the origin that looks up, ``height(xy)`` above ``z``."""
    line = np.linspace(-side, side, pieces + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    number = np.arange((pieces + 1) ** 2).reshape(pieces + 1, pieces + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)
    if height is not None:
        points[:, 2] += height(points[:, :2])
    return SurfaceMesh(points, faces.astype(np.int32))


def flat_uvs(mesh: SurfaceMesh, side: float = 1.0) -> np.ndarray:
    """(f, 3, 2) float32 UVs of a sheet: x and y over most of the atlas."""
    plane = mesh.vertices[:, :2] / side * 0.45 + 0.5
    return plane[mesh.faces].astype(np.float32)


def degrees_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Angles of (..., 3) unit vectors; exact for small ones, where the cosine is not."""
    chord = np.linalg.norm(one - other, axis=-1)
    return np.degrees(2.0 * np.arcsin((chord / 2.0).clip(0.0, 1.0)))
