# SPDX-License-Identifier: GPL-3.0-or-later
"""Distances from points to a mesh or a point cloud, precise at large coordinates."""

from __future__ import annotations

import igl
import numpy as np
from scipy.spatial import cKDTree


def distances_to_mesh(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distance of each point to a triangle mesh, with the nearest face and point.

    Parameters
    ----------
    points : (n, 3) float64
    vertices : (v, 3) float64
    faces : (f, 3) int
        Degenerate faces count as the segment or point that they are. libigl uses as many threads
        as there are cores.

    Returns
    -------
    distances : (n,) float64
        Infinite where the mesh has no faces.
    face : (n,) int64
        The face of the nearest point, -1 without faces.
    closest : (n, 3) float64
        The nearest point, infinite without faces.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    count = len(points)
    if count == 0 or len(faces) == 0:
        return np.full(count, np.inf), np.full(count, -1), np.full((count, 3), np.inf)
    vertices = np.asarray(vertices, np.float64)
    used, inverse = np.unique(faces, return_inverse=True)
    corners = vertices[used]
    # Relative to the mesh: at coordinates of 4e6 nearest points would be rounded to the last digit.
    origin = (corners.min(0) + corners.max(0)) / 2
    local = np.ascontiguousarray(points - origin)
    triangles = np.ascontiguousarray(inverse.reshape(-1, 3), np.int64)
    _, face, closest = igl.point_mesh_squared_distance(
        local, np.ascontiguousarray(corners - origin), triangles
    )
    return np.linalg.norm(local - closest, axis=1), face, closest + origin


def distances_to_cloud(
    points: np.ndarray, cloud: np.ndarray, *, threads: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of each point to the nearest point of a cloud.

    Parameters
    ----------
    points : (n, 3) float64
    cloud : (m, 3) float64
    threads : int
        Threads of the search; the result does not depend on it.

    Returns
    -------
    distances : (n,) float64
        Infinite where the cloud is empty.
    index : (n,) int64
        Row of ``cloud``, -1 where it is empty.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    if len(cloud) == 0 or len(points) == 0:
        return np.full(len(points), np.inf), np.full(len(points), -1)
    tree = cKDTree(np.asarray(cloud, np.float64))
    distances, index = tree.query(points, workers=threads)
    return distances, index
