# SPDX-License-Identifier: GPL-3.0-or-later
"""Samples on surfaces, and distances to them."""

from __future__ import annotations

import igl
import numpy as np
from scipy.spatial import cKDTree

from ..compiled import kernel, part
from .surface_mesh import normals_and_areas

# -- Sample points on triangles: uniform by area, and Poisson-disk thinning -----------------------

POINTS_PER_SQUARE = 0.56
"""Points per squared radius of area after thinning, with as many candidates as surface_points uses
(measured on a sphere; the densest random packing has 0.70)."""

EDGE_PER_RADIUS = 1.5  # mean edge of the triangulated points, in radii (same measurement)

SAME_SIDE_COSINE = -0.2
OTHER_SIDE_SHARE = 0.1
"""Two points on opposite sides of a thin wall do not conflict, unless they are closer than this
share of the radius."""

LEVEL_STEP = 2.0  # ratio between the cell sides of successive levels of thinning


def sample_triangles(
    vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator,
    density: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Draw ``count`` points uniformly by area (stratified along the list of faces).

    ``density``: (f,) float64 relative number of points per area of each face.
    Returns points (count, 3) float64 and their faces (count,) int64.
    """
    _, areas = normals_and_areas(vertices, faces)
    total = np.cumsum(areas if density is None else areas * density)
    where = (np.arange(count) + rng.random(count)) / count * total[-1]
    face = np.minimum(np.searchsorted(total, where, side="right"), len(faces) - 1)
    root, second = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - second), root * second], 1)  # (count, 3)
    return np.einsum("kc,kcx->kx", weights, vertices[faces[face]]), face


def thin(
    points: np.ndarray, normals: np.ndarray, radii: np.ndarray, priority: np.ndarray
) -> np.ndarray:
    """Select points that are at least a radius apart, greedily in order of priority.

    Two points conflict if they are closer than the smaller of their radii and lie on the same
    side of a wall (their normals agree); points with zero normals can conflict with any other.

    ``points`` and ``normals`` are (n, 3) float64, ``radii`` and ``priority`` (n,) float64: smaller
    values come first, ties by index. Returns (n,) bool.
    """
    if len(points) == 0:
        return np.zeros(0, np.bool_)
    kept = np.zeros(len(points), np.bool_)
    finest = float(radii.min())
    level = np.floor(np.log(radii / finest) / np.log(LEVEL_STEP) + 1e-9).astype(np.int64)  # (n,)
    # A radius is at most the side of its level's cells, so conflicts lie within 27 cells.
    sides = finest * LEVEL_STEP ** (1.0 + 1e-6 + np.arange(level.max() + 1))
    _thin_kernel(
        np.argsort(priority, kind="stable"), points - points.min(0), normals, radii, level, sides,
        2 ** max(4, len(points).bit_length()) - 1, SAME_SIDE_COSINE, OTHER_SIDE_SHARE, kept,
    )  # fmt: skip
    return kept


@part(fast=False)
def _bucket(level, x, y, z, mask):  # type: ignore[no-untyped-def]
    """Hash a cell. Collisions only cost time, since distances are compared."""
    key = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791) ^ (level * 50331653)
    key ^= key >> 17
    return key & mask


@kernel(fast=False)
def _thin_kernel(  # type: ignore[no-untyped-def]
    sequence, points, normals, radii, level, sides, mask, same, share, kept
):
    # Accepted points of each cell, as linked lists; rejected points need not be visited again.
    head = np.full(mask + 1, -1, np.int64)
    following = np.full(len(points), -1, np.int64)
    filled = np.zeros(len(sides), np.bool_)
    for i in sequence:
        free = True
        for other in range(len(sides)):
            if not filled[other]:
                continue
            # Only points closer than both radii conflict.
            reach = min(radii[i], sides[other])
            low0 = int(np.floor((points[i, 0] - reach) / sides[other]))
            low1 = int(np.floor((points[i, 1] - reach) / sides[other]))
            low2 = int(np.floor((points[i, 2] - reach) / sides[other]))
            high0 = int(np.floor((points[i, 0] + reach) / sides[other]))
            high1 = int(np.floor((points[i, 1] + reach) / sides[other]))
            high2 = int(np.floor((points[i, 2] + reach) / sides[other]))
            for cell0 in range(low0, high0 + 1):
                for cell1 in range(low1, high1 + 1):
                    for cell2 in range(low2, high2 + 1):
                        j = head[_bucket(other, cell0, cell1, cell2, mask)]
                        while j >= 0:
                            x = points[i, 0] - points[j, 0]
                            y = points[i, 1] - points[j, 1]
                            z = points[i, 2] - points[j, 2]
                            limit = min(radii[i], radii[j])
                            square = x * x + y * y + z * z
                            if square < limit * limit:
                                cosine = (
                                    normals[i, 0] * normals[j, 0]
                                    + normals[i, 1] * normals[j, 1]
                                    + normals[i, 2] * normals[j, 2]
                                )
                                if cosine >= same or square < share * share * limit * limit:
                                    free = False
                                    break
                            j = following[j]
                        if not free:
                            break
                    if not free:
                        break
                if not free:
                    break
            if not free:
                break
        if free:
            kept[i] = True
            own = level[i]
            filled[own] = True
            bucket = _bucket(
                own, int(np.floor(points[i, 0] / sides[own])),
                int(np.floor(points[i, 1] / sides[own])),
                int(np.floor(points[i, 2] / sides[own])), mask,
            )  # fmt: skip
            following[i] = head[bucket]
            head[bucket] = i


# -- Distances from points to a mesh or a point cloud, precise at large coordinates ---------------


def distances_to_mesh(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distance of each point to a triangle mesh, with the nearest face and point.

    Degenerate faces count as the segment or point that they are. libigl uses as many threads as
    there are cores.
    Returns (n,) float64, (n,) int64 and (n, 3) float64; inf, -1 and inf where there are no faces.
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
    """Return the distance of each point (n, 3) to the nearest point of a cloud (m, 3), and its row.

    Returns (n,) float64 and int64; inf and -1 where the cloud is empty. The result does not depend
    on the number of threads.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    if len(cloud) == 0 or len(points) == 0:
        return np.full(len(points), np.inf), np.full(len(points), -1)
    return cKDTree(np.asarray(cloud, np.float64)).query(points, workers=threads)
