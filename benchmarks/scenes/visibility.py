# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays against the whole geometry of a scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.errors import ResourceError

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
