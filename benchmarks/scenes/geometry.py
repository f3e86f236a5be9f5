# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangle meshes that the scenes are made of: parts, an OBJ reader, and closed solids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.errors import ParseError


@dataclass(frozen=True)
class Part:
    """A piece of a scene with one material."""

    name: str
    vertices: np.ndarray
    """(v, 3) float64, world frame, z up."""
    faces: np.ndarray
    """(f, 3) int32, counter-clockwise seen from outside."""
    material: str
    corner_uvs: np.ndarray | None = None
    """(f, 3, 2) float64 or None."""
    surrounding: bool = False
    """Belongs to the room around; light passes through it, so that a closed room is lit."""
    smooth: bool = True
    """Shade edges below :data:`SHARP_DEGREES` smoothly; the geometry is the same."""


SHARP_DEGREES = 40.0
"""Edges that bend more than this look sharp."""


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Read a triangle OBJ file.

    Returns
    -------
    vertices : (v, 3) float64
    faces : (f, 3) int32
    corner_uvs : (f, 3, 2) float64 or None
        None where the file has no texture coordinates.

    Raises
    ------
    ParseError
        A face is not a triangle.
    """
    vertices: list[list[float]] = []
    uvs: list[list[float]] = []
    faces: list[list[int]] = []
    uv_faces: list[list[int]] = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            vertices.append([float(word) for word in words[1:4]])
        elif words[0] == "vt":
            uvs.append([float(word) for word in words[1:3]])
        elif words[0] == "f":
            if len(words) != 4:
                raise ParseError(path, f"line {number}", "not a triangle.", "Triangulate the mesh.")
            corners = [word.split("/") for word in words[1:]]
            faces.append([int(corner[0]) - 1 for corner in corners])
            if len(corners[0]) > 1 and corners[0][1]:
                uv_faces.append([int(corner[1]) - 1 for corner in corners])
    corner_uvs = np.array(uvs)[np.array(uv_faces)] if len(uv_faces) == len(faces) else None
    return np.array(vertices, np.float64), np.array(faces, np.int32), corner_uvs


def scaled_to(vertices: np.ndarray, diagonal: float) -> np.ndarray:
    """Return (v, 3) vertices with the middle of their box at 0 and the given box diagonal."""
    low, high = vertices.min(0), vertices.max(0)
    return (vertices - (low + high) / 2) * (diagonal / float(np.linalg.norm(high - low)))


def joined(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (v, 3) and faces (f, 3) of all parts in one mesh."""
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return (
        np.concatenate([part.vertices for part in parts]),
        np.concatenate(faces).astype(np.int32),
    )


def box(
    name: str, low: Sequence[float], high: Sequence[float], material: str, turn_degrees: float = 0.0
) -> Part:
    """Return a closed box, turned about the vertical through its middle."""
    lo, hi = np.array(low, np.float64), np.array(high, np.float64)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
    vertices = lo + corners * (hi - lo)  # (8, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [tri for a, b, c, d in quads for tri in ((a, b, c), (a, c, d))]
    middle = (lo + hi) / 2
    angle = np.radians(turn_degrees)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    vertices = (vertices - middle) @ turn.T + middle
    return Part(name, vertices, np.array(faces, np.int32), material, smooth=False)


def cone(
    name: str,
    start: Sequence[float],
    end: Sequence[float],
    start_radius: float,
    end_radius: float,
    material: str,
    sides: int = 24,
) -> Part:
    """Return a closed (truncated) cone or cylinder between two points."""
    a, b = np.array(start, np.float64), np.array(end, np.float64)
    axis = (b - a) / np.linalg.norm(b - a)
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angles = 2 * np.pi * np.arange(sides) / sides
    ring = np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v  # (sides, 3)
    vertices = np.concatenate([a + start_radius * ring, b + end_radius * ring, [a], [b]])
    faces = []
    for k in range(sides):
        j = (k + 1) % sides
        faces += [(k, j, sides + j), (k, sides + j, sides + k)]
        faces += [(j, k, 2 * sides), (sides + k, sides + j, 2 * sides + 1)]
    return Part(name, vertices, np.array(faces, np.int32), material)


def icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vertices (v, 3) and outward faces (f, 3) of a subdivided icosahedron."""
    g = (1 + np.sqrt(5)) / 2
    points = [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g], [0, -1, -g],
              [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]]  # fmt: skip
    faces = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4],
             [11, 10, 2], [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8],
             [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]]  # fmt: skip
    vertices, triangles = np.array(points, np.float64), np.array(faces, np.int64)
    for _ in range(subdivisions):
        edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        middle = len(vertices) + index.reshape(-1, 3)  # (f, 3) vertices on edges 01, 12, 20
        vertices = np.concatenate([vertices, vertices[unique].mean(1)])
        a, b, c = triangles.T
        ab, bc, ca = middle.T
        triangles = np.concatenate(
            [np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, triangles.astype(np.int32)
