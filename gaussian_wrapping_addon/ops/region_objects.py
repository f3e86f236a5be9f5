# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions as Blender objects: an Empty cube for a box, a wire mesh for any other convex solid."""

from __future__ import annotations

from pathlib import Path

import bmesh
import bpy
import numpy as np
from mathutils import Matrix

from ..core.errors import UsageError
from ..core.files import read_json, write_json
from . import tags
from .region_geometry import (
    CUBE_CORNERS,
    CUBE_TRIANGLES,
    box_matrix,
    check_volume,
    region_to_json,
    vertices_of_region,
)


def matrix_of(thing: bpy.types.Object) -> np.ndarray:
    """Return the (4, 4) float64 world matrix of an object as it stands now, hidden or not."""
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
        The frame was scaled to nothing.
    """
    if frame is None:
        return np.eye(4)
    try:
        inverse = np.linalg.inv(matrix_of(frame))
    except np.linalg.LinAlgError:
        inverse = np.full((4, 4), np.nan)
    if not np.isfinite(inverse).all():
        raise UsageError(f"{frame.name} has no size.", "Clear its scale (Alt S).")
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
    UsageError
        The object is of another kind, or encloses no volume.
    """
    matrix = matrix_of(thing)
    if thing.type == "EMPTY":
        if thing.empty_display_type != "CUBE":
            raise UsageError(
                f"Empty {thing.name} is not displayed as a cube.", "Set Display As to Cube."
            )
        corners = CUBE_CORNERS * thing.empty_display_size
        vertices, triangles = transformed(matrix, corners), list(CUBE_TRIANGLES)
    elif thing.type == "MESH":
        local, triangles = _mesh_hull(thing)
        vertices = transformed(matrix, local)
    else:
        raise UsageError(
            f"{thing.name} is a {thing.type.lower()}, not a region.", "Use a region box or a mesh."
        )
    check_volume(vertices, thing.name)
    return vertices, triangles


def _mesh_hull(thing: bpy.types.Object) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    work = bmesh.new()
    try:
        mesh = evaluated.to_mesh()
        work.from_mesh(mesh)
        evaluated.to_mesh_clear()
        if len(work.verts) < 4:
            raise UsageError(
                f"Region {thing.name} has {len(work.verts)} vertices.", "Use a box or a solid."
            )
        bmesh.ops.delete(work, geom=work.edges[:] + work.faces[:], context="EDGES_FACES")
        bmesh.ops.convex_hull(work, input=work.verts[:], use_existing_faces=False)
        used = {vertex for face in work.faces for vertex in face.verts}
        if not used:
            raise UsageError(f"Region {thing.name} is flat.", "Give it a thickness.")
        bmesh.ops.delete(work, geom=[v for v in work.verts if v not in used], context="VERTS")
        bmesh.ops.triangulate(work, faces=work.faces[:])
        work.verts.index_update()
        vertices = np.array([v.co[:] for v in work.verts], np.float64)
        triangles = [tuple(v.index for v in face.verts) for face in work.faces]
    finally:
        work.free()
    return vertices, triangles  # type: ignore[return-value]


def region_from_object(thing: bpy.types.Object) -> np.ndarray:
    """Return the (n, 3) float64 hull vertices of a region object in the world of the input.

    The way is Blender -> scene frame (the parent empty's matrix) -> world (its
    ``world_from_scene``); an object without a result's parent is taken to be in the world.

    Raises
    ------
    UsageError
        The object cannot be a region, or its frame has lost its coordinates.
    """
    return _region_in_world(thing)[0]


def _region_in_world(thing: bpy.types.Object) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    frame = tags.frame_of(thing)
    vertices, triangles = hull_in_blender(thing)
    if frame is not None:
        vertices = transformed(scene_from_blender(frame), vertices)
        vertices = tags.world_from_scene(frame).points(vertices)
    return vertices, triangles


def export_region(thing: bpy.types.Object, path: Path) -> None:
    """Write a region object as bounding-volume JSON in world coordinates."""
    vertices, triangles = _region_in_world(thing)
    try:
        write_json(path, region_to_json(thing.name, vertices, triangles))
    except OSError as error:
        raise UsageError(
            f"{path} cannot be written: {error.strerror}.", "Choose another."
        ) from None


def read_region_vertices(path: Path) -> np.ndarray:
    """Return the (n, 3) world vertices of a region file."""
    if not path.is_file():
        raise UsageError(f"{path} does not exist.", "Choose a region file.")
    return vertices_of_region(read_json(path), path)


def create_region(
    name: str,
    vertices: np.ndarray,
    frame: bpy.types.Object | None,
    collection: bpy.types.Collection,
) -> bpy.types.Object:
    """Make a region object of (n, 3) vertices in the scene frame (of ``frame``).

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
        raise UsageError("Nothing with an extent is selected.", "Select a mesh object.")
    points = transformed(scene_from_blender(frame), np.concatenate(corners))
    low, high = points.min(0), points.max(0)
    # A flat object still gets a box that encloses a volume.
    half = np.maximum(0.5 * (high - low), 0.01 * float((high - low).max()) + 1e-6)
    return 0.5 * (low + high) + half * CUBE_CORNERS
