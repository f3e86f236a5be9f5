# SPDX-License-Identifier: GPL-3.0-or-later
"""Shapes of scenes, what rays see of them, and where cameras stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.errors import ParseError, ResourceError
from gaussian_wrapping_addon.core.scene.camera import Camera


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


START_SHARE = 2e-5
"""Rays start this share of the geometry's diagonal off the surface: embree's rays are float32."""


class RayScene:
    """All surfaces of a scene; both sides stop rays."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        try:
            import embreex  # noqa: F401 - trimesh uses it where it is installed
            import trimesh
        except ModuleNotFoundError:
            raise ResourceError(
                "The ground truth is found with rays; trimesh or embreex is missing.",
                "Install them: pip install trimesh==5.2.0 embreex.",
            ) from None
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        self._rays = mesh.ray
        self.normals = np.asarray(mesh.face_normals, np.float64)  # (f, 3)
        self.diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))

    def first_hits(
        self, origins: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return distance (n,) in units of ``directions`` and face (n,); inf and -1: no hit."""
        face = self._rays.intersects_first(origins, directions)
        distance = np.full(len(origins), np.inf)
        hit = np.flatnonzero(face >= 0)
        normal = self.normals[face[hit]]
        corner = self._rays.mesh.vertices[self._rays.mesh.faces[face[hit], 0]]
        # From the face's plane in float64: embree's own distance is float32.
        slope = np.einsum("ij,ij->i", normal, directions[hit])
        above = np.einsum("ij,ij->i", normal, corner - origins[hit])
        distance[hit] = above / np.where(np.abs(slope) > 1e-12, slope, 1e-12)
        return distance, face

    def sees(self, camera: Camera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Tell which points the camera sees, from their front side and unobstructed.

        Parameters
        ----------
        points : (n, 3) float64
            On the surface.
        normals : (n, 3) float64
            Unit.

        Returns
        -------
        (n,) bool
        """
        pixels, depth = camera.project(points)
        inside = (depth > 0) & (pixels >= 0).all(1)
        inside &= (pixels < [camera.width, camera.height]).all(1)
        to_camera = camera.center - points
        inside &= np.einsum("ij,ij->i", to_camera, normals) > 0
        seen = np.zeros(len(points), bool)
        index = np.flatnonzero(inside)
        start = points[index] + START_SHARE * self.diagonal * normals[index]
        way = camera.center - start  # distance 1 is the camera itself
        distance, _ = self.first_hits(start, way)
        seen[index] = ~(distance < 1.0)
        return seen


def count_views(
    rays: RayScene, cameras: Sequence[Camera], points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Return how many cameras see each point, (n,) int32."""
    count = np.zeros(len(points), np.int32)
    for camera in cameras:
        count += rays.sees(camera, points, normals)
    return count


PRINCIPAL_POINT = (0.507, 0.493)
"""Shares of width and height: not quite the middle, as in real lenses."""

RINGS = ((0.36, 33.0), (0.38, 6.0), (0.26, -17.0))
"""Share of the photos and elevation in degrees of each ring around a thing."""

_GOLDEN = 0.618034


def look_at(center: np.ndarray, target: np.ndarray, roll_degrees: float) -> np.ndarray:
    """Return (3, 4) cam_from_world of a camera that looks at a point; world z is up."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(np.radians(roll_degrees)), np.sin(np.radians(roll_degrees))
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    return np.concatenate([rotation, -(rotation @ center)[:, None]], 1)


def _camera(name: str, pose: np.ndarray, width: int, height: int, focal_share: float) -> Camera:
    focal = focal_share * width
    cx, cy = PRINCIPAL_POINT[0] * width, PRINCIPAL_POINT[1] * height
    return Camera(name, width, height, focal, focal, cx, cy, pose)


def around_thing(
    count: int, width: int, height: int, distance: float, random: np.random.Generator, prefix: str
) -> list[Camera]:
    """Return cameras on rings around 0, each with small errors of a hand.

    Test views ("test" prefix) stand between the rings, elevations as the random numbers say.
    """
    cameras: list[Camera] = []
    if prefix == "test":
        rings = [(count, None)]
    else:
        counts = [round(share * count) for share, _ in RINGS[:-1]]
        counts.append(count - sum(counts))
        rings = [(n, elevation) for n, (_, elevation) in zip(counts, RINGS, strict=True)]
    for ring, (number, elevation) in enumerate(rings):
        for k in range(number):
            angle = 2 * np.pi * (k + _GOLDEN * ring + random.uniform(-0.15, 0.15)) / number
            lift = random.uniform(-8, 24) if elevation is None else elevation
            lift = np.radians(lift + random.uniform(-4, 4))
            direction = np.array(
                [np.cos(lift) * np.cos(angle), np.cos(lift) * np.sin(angle), np.sin(lift)]
            )
            center = direction * distance * random.uniform(0.93, 1.08)
            target = random.normal(size=3) * 0.04 * distance / 2.5
            pose = look_at(center, target, random.uniform(-3, 3))
            name = f"{prefix}_{len(cameras):03d}.png"
            cameras.append(_camera(name, pose, width, height, 0.92))
    return cameras


def inside_room(
    count: int,
    width: int,
    height: int,
    low: np.ndarray,
    high: np.ndarray,
    random: np.random.Generator,
    prefix: str,
) -> list[Camera]:
    """Return cameras on a walk around the room's middle that look across it, up and down."""
    middle, half = (low + high) / 2, (high - low) / 2
    cameras: list[Camera] = []
    phase = 0.5 if prefix == "test" else 0.0
    for k in range(count):
        angle = 2 * np.pi * (k + phase + random.uniform(-0.2, 0.2)) / count
        reach = (0.62, 0.45, 0.56)[k % 3]
        center = np.array([np.cos(angle) * half[0] * reach, np.sin(angle) * half[1] * reach, 0.0])
        center += [middle[0], middle[1], random.uniform(1.15, 1.75)]
        pan = np.radians((0.0, 48.0, -48.0)[k % 3] + random.uniform(-8, 8))
        pitch = np.radians((-15.0, -32.0, -4.0, -22.0, 14.0)[k % 5] + random.uniform(-4, 4))
        # Across the room as the walls stand: the direction to the opposite point of the ellipse.
        yaw = np.arctan2(np.sin(angle) * half[1], np.cos(angle) * half[0]) + np.pi + pan
        direction = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
        pose = look_at(center, center + np.array(direction), random.uniform(-3, 3))
        cameras.append(_camera(f"{prefix}_{k:03d}.png", pose, width, height, 0.62))
    return cameras
