# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions as Blender objects: an Empty cube for a box, a wire mesh for any other convex solid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bmesh
import bpy
import numpy as np
from mathutils import Matrix

from ...core.errors import UsageError
from ...core.regions.box import CUBE_CORNERS, CUBE_TRIANGLES, box_matrix
from ...core.regions.region_file import region_to_json, write_region_file
from ...core.regions.volume import check_volume
from ..common import tags
from ..common.mesh_data import evaluated, values_of
from .region_hull import convex_hull

# Share of the hull's volume by which that of a convex mesh may be off (float32 coordinates).
CONVEX_TOLERANCE = 1e-3


def matrix_of(thing: bpy.types.Object) -> np.ndarray:
    """Return the current (4, 4) float64 world matrix of an object, hidden or not."""
    evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if evaluated.is_evaluated:
        return np.array(evaluated.matrix_world, np.float64)
    # Blender does not update what is disabled in viewports: its matrix_world may be an old one.
    matrix = np.array(thing.matrix_basis, np.float64)
    if thing.parent is not None:
        matrix = matrix_of(thing.parent) @ np.array(thing.matrix_parent_inverse) @ matrix
    return matrix


def transformed(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a (4, 4) affine matrix to (n, 3) points."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def scene_from_blender(frame: bpy.types.Object | None) -> np.ndarray:
    """Return the (4, 4) matrix from Blender's world to the scene frame.

    Raises
    ------
    UsageError
        The scale of the frame is zero.
    """
    if frame is None:
        return np.eye(4)
    try:
        inverse = np.linalg.inv(matrix_of(frame))
    except np.linalg.LinAlgError:
        inverse = np.full((4, 4), np.nan)
    if not np.isfinite(inverse).all():
        raise UsageError(f"{frame.name} has zero scale.", "Clear its scale (Alt S).")
    return inverse


def hull_in_blender(thing: bpy.types.Object) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    """Return the convex hull of a region object in Blender's world.

    Parameters
    ----------
    thing : Object
        An Empty displayed as a cube, or a mesh (with its modifiers).

    Returns
    -------
    vertices : (n, 3) float64
    triangles : list of index triples

    Raises
    ------
    UsageError, MeshingError
        The object is of another type, or encloses no volume.
    """
    local, triangles = local_hull(thing)
    vertices = transformed(matrix_of(thing), local)
    check_volume(vertices, thing.name)
    return vertices, triangles


def local_hull(thing: bpy.types.Object) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    """Return the convex hull of a region object in its own coordinates.

    As :func:`hull_in_blender`, which also checks that it encloses a volume.
    """
    if thing.type == "EMPTY":
        if thing.empty_display_type != "CUBE":
            raise UsageError(
                f"Empty {thing.name} is not displayed as a cube.", "Set Display As to Cube."
            )
        return CUBE_CORNERS * thing.empty_display_size, list(CUBE_TRIANGLES)
    if thing.type == "MESH":
        return _mesh_hull(thing)
    raise UsageError(
        f"{thing.name} is a {thing.type.lower()}, not a region.", "Use a region box or a mesh."
    )


def _mesh_hull(thing: bpy.types.Object) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    shown = evaluated(thing)
    mesh = shown.to_mesh()
    points = values_of(mesh.vertices, "co", 3, np.float32)
    shown.to_mesh_clear()
    return convex_hull(points.reshape(-1, 3).astype(np.float64), thing.name)


def is_convex(thing: bpy.types.Object) -> bool:
    """Return whether a mesh, with its modifiers, is closed and convex."""
    hull, triangles = _mesh_hull(thing)
    center = hull.mean(0)
    shown = evaluated(thing)
    mesh = shown.to_mesh()
    mesh.calc_loop_triangles()
    vertices = values_of(mesh.vertices, "co", 3, np.float32)
    corners = values_of(mesh.loop_triangles, "vertices", 3, np.int32)
    shown.to_mesh_clear()
    own = vertices.reshape(-1, 3).astype(np.float64)[corners.reshape(-1, 3)] - center  # (m, 3, 3)
    volume = abs(float(np.linalg.det(own).sum()))
    # The hull's triangles may wind either way; seen from inside, all of them count.
    whole = float(np.abs(np.linalg.det(hull[np.array(triangles)] - center)).sum())
    return abs(volume - whole) <= CONVEX_TOLERANCE * whole


def region_body(thing: bpy.types.Object, name: str = "") -> dict[str, Any]:
    """Return the bounding-volume JSON of a region object, named as the object by default.

    Its hull is in the world of the input. The way is Blender -> scene frame (the parent empty's
    matrix) -> world (its ``world_from_scene``); an object outside a result is taken to be in world
    coordinates.

    Raises
    ------
    UsageError, MeshingError
        The object cannot be a region, or its frame has lost its coordinates.
    """
    frame = tags.frame_of(thing)
    vertices, triangles = hull_in_blender(thing)
    if frame is not None:
        vertices = transformed(scene_from_blender(frame), vertices)
        vertices = tags.world_from_scene(frame).points(vertices)
    return region_to_json(name or thing.name, vertices, triangles)


def export_region(thing: bpy.types.Object, path: Path, name: str = "") -> None:
    """Write a region object in world coordinates, in the format that the suffix names."""
    body = region_body(thing, name)
    try:
        write_region_file(
            path, body["blender_object_name"], body["vertices"], body["hull_simplices"]
        )
    except OSError as error:
        raise UsageError(
            f"{path} cannot be written: {error.strerror}.", "Choose another."
        ) from None


def create_region(
    name: str,
    vertices: np.ndarray,
    frame: bpy.types.Object | None,
    collection: bpy.types.Collection,
) -> bpy.types.Object:
    """Create a region object from (n, 3) vertices in the scene frame (of ``frame``).

    A box becomes an Empty cube, which can be moved, turned and scaled; any other solid becomes
    a mesh of its convex hull.
    """
    matrix = box_matrix(vertices)
    if matrix is not None:
        thing = bpy.data.objects.new(name, None)
        thing.empty_display_type = "CUBE"
        thing.empty_display_size = 1.0
        thing.matrix_basis = Matrix(matrix.tolist())
    else:
        center = vertices.mean(0)
        thing = bpy.data.objects.new(name, _hull_mesh(name, vertices - center))
        thing.display_type = "WIRE"
        thing.hide_render = True
        thing.location = center.tolist()
    thing.show_in_front = True
    thing[tags.KIND] = "region"
    if frame is not None:
        thing.parent = frame
    collection.objects.link(thing)
    return thing


def _hull_mesh(name: str, vertices: np.ndarray) -> bpy.types.Mesh:
    work = bmesh.new()
    try:
        for vertex in vertices:
            work.verts.new(vertex.tolist())
        bmesh.ops.convex_hull(work, input=work.verts[:])
        mesh = bpy.data.meshes.new(name)
        work.to_mesh(mesh)
    finally:
        work.free()
    return mesh


def box_around(things: list[bpy.types.Object], frame: bpy.types.Object | None) -> np.ndarray:
    """Return the (8, 3) corners, in the scene frame, of the box around objects.

    Raises
    ------
    UsageError
        None of the objects has an extent.
    """
    corners = [
        transformed(matrix_of(thing), np.array(thing.bound_box, np.float64))
        for thing in things
        if thing.type in ("MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD")
    ]
    if not corners:
        raise UsageError("The selected objects have no extent.", "Select a mesh object.")
    points = transformed(scene_from_blender(frame), np.concatenate(corners))
    low, high = points.min(0), points.max(0)
    # A flat object still gets a box that encloses a volume.
    half = np.maximum(0.5 * (high - low), 0.01 * float((high - low).max()) + 1e-6)
    return 0.5 * (low + high) + half * CUBE_CORNERS
