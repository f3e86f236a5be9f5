# SPDX-License-Identifier: GPL-3.0-or-later
"""Automatic up direction and ground plane of a result in Blender."""

from __future__ import annotations

import bpy
import numpy as np

from ...core.dataset.frames.camera_up import camera_up
from ...core.dataset.frames.ground import find_ground_plane
from ...core.dataset.frames.placement import Plane
from ...core.errors import UsageError
from ..cameras.camera_objects import cameras_under
from ..common import tags
from ..common.mesh_data import mesh_of, values_of
from ..regions.region_objects import hull_in_blender, matrix_of, transformed

_FLIP_YZ = np.array([1.0, -1.0, -1.0])


def camera_poses(frame: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of a result's photo cameras in Blender's world.

    Returns
    -------
    rotations : (n, 3, 3) float64
        ``cam_from_world``: x right, y down, z forward.
    centers : (n, 3) float64
    """
    rotations, centers = [], []
    for camera in cameras_under(frame):
        matrix = matrix_of(camera)
        axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)  # (3, 3), one a column
        rotations.append((axes * _FLIP_YZ).T)
        centers.append(matrix[:3, 3])
    return np.array(rotations).reshape(-1, 3, 3), np.array(centers).reshape(-1, 3)


def automatic_plane(frame: bpy.types.Object) -> tuple[Plane, str]:
    """Find the ground of a result; return the plane and the rule used.

    Up comes from the cameras. The ground is the main level plane of the meshes; if none is
    clear, it passes through their lowest point; without meshes, through the regions' lowest corner.

    Raises
    ------
    UsageError
        The cameras do not determine up, or nothing determines the ground.
    """
    up, rule = camera_up(*camera_poses(frame))
    meshes = [c for c in frame.children if tags.kind_of(c) == "mesh" and c.type == "MESH"]
    surface = [_triangles(mesh) for mesh in meshes]
    corners = np.concatenate([np.zeros((0, 3, 3)), *surface])  # (f, 3, 3)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(length, 1e-300)[:, None]
    plane = find_ground_plane(corners.mean(1), normals, 0.5 * length, up)
    if plane is not None:
        return plane, f"Up by {rule}, ground by the main plane"
    # A mesh that the region cuts off below ends at the region's lowest face.
    points, what = corners.reshape(-1, 3), "lowest point of the meshes"
    if len(points) == 0:
        regions = [hull_in_blender(c)[0] for c in frame.children if tags.kind_of(c) == "region"]
        points, what = np.concatenate([np.zeros((0, 3)), *regions]), "lowest corner of the regions"
    if len(points) == 0:
        raise UsageError(
            "The result has neither mesh nor region to find the ground by.",
            "Import the result again.",
        )
    middle = points.mean(0)
    lowest = float(((points - middle) @ up).min())
    return Plane(middle + lowest * up, up), f"Up by {rule}, ground by the {what}"


def _triangles(thing: bpy.types.Object) -> np.ndarray:
    """Return the (f, 3, 3) corners of an object's triangles in Blender's world."""
    mesh = mesh_of(thing)
    mesh.calc_loop_triangles()
    corners = values_of(mesh.loop_triangles, "vertices", 3, np.int32)
    vertices = values_of(mesh.vertices, "co", 3, np.float32)
    placed = transformed(matrix_of(thing), vertices.reshape(-1, 3).astype(np.float64))
    return placed[corners].reshape(-1, 3, 3)
