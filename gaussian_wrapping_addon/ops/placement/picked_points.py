# SPDX-License-Identifier: GPL-3.0-or-later
"""Points picked on a result: selected vertices in Edit Mode, or selected empties."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np

from ...core.errors import UsageError
from ..common import tags
from ..common.mesh_data import mesh_of
from ..regions.region_objects import matrix_of, scene_from_blender, transformed

# Size of a new point's cross, in scene units: a hundredth of the cameras' reach.
_POINT_SIZE = 0.05


def point_empties(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected empties that are points: no region, no parent of a result."""
    return [
        thing
        for thing in context.selected_objects
        if thing.type == "EMPTY" and tags.kind_of(thing) in ("", "point")
    ]


def picked_points(context: bpy.types.Context, frame: bpy.types.Object) -> np.ndarray:
    """Return the points picked on the result of ``frame``.

    In Edit Mode the selected vertices of its meshes, else the selected empties; one without
    a parent becomes a child of the frame in place, so that it moves along.

    Returns
    -------
    points : (n, 3) float64
        Blender's world.

    Raises
    ------
    UsageError
        A mesh in Edit Mode, or an empty, belongs to something else.
    """
    if context.mode == "EDIT_MESH":
        found = [_selected_vertices(thing, frame) for thing in context.objects_in_mode]
        return np.concatenate([np.zeros((0, 3)), *found])
    empties = point_empties(context)
    for thing in empties:
        if thing.parent is None:
            _adopt(thing, frame)
        elif tags.frame_of(thing) != frame:
            raise UsageError(
                f"{thing.name} belongs to {thing.parent.name}, not to {frame.name}.",
                "Clear its parent (Alt P).",
            )
    matrices = [matrix_of(thing) for thing in empties]
    return np.array([matrix[:3, 3] for matrix in matrices]).reshape(-1, 3)


def _selected_vertices(thing: bpy.types.Object, frame: bpy.types.Object) -> np.ndarray:
    vertices = [v.co[:] for v in bmesh.from_edit_mesh(mesh_of(thing)).verts if v.select]
    if vertices and tags.frame_of(thing) != frame:
        raise UsageError(
            f"{thing.name} is not part of the result under {frame.name}.",
            "Pick on a mesh of the result, or put points with Add Point.",
        )
    return transformed(matrix_of(thing), np.array(vertices, np.float64).reshape(-1, 3))


def _adopt(thing: bpy.types.Object, frame: bpy.types.Object) -> None:
    local = transformed(scene_from_blender(frame), matrix_of(thing)[None, :3, 3])[0]
    thing.parent = frame
    thing.matrix_parent_inverse.identity()
    thing.location = local.tolist()
    thing[tags.KIND] = "point"
    bpy.context.view_layer.update()


def add_point(context: bpy.types.Context, frame: bpy.types.Object) -> bpy.types.Object:
    """Add a point under the frame at the 3D cursor; it and other points stay selected."""
    cursor = np.array(context.scene.cursor.location, np.float64)
    keep = point_empties(context)
    for thing in context.selected_objects:
        thing.select_set(thing in keep)
    point = bpy.data.objects.new("Point", None)
    point.empty_display_type = "PLAIN_AXES"
    point.empty_display_size = _POINT_SIZE
    point.show_in_front = point.show_name = True
    point.hide_render = True
    point.parent = frame
    point.location = transformed(scene_from_blender(frame), cursor[None])[0].tolist()
    point[tags.KIND] = "point"
    (frame.users_collection[0] if frame.users_collection else context.collection).objects.link(
        point
    )
    context.view_layer.update()  # a new object cannot be selected before
    point.select_set(True)
    context.view_layer.objects.active = point
    return point


def release(context: bpy.types.Context) -> None:
    """Leave Edit Mode and deselect the points, so that the next tool starts from none.

    In Edit Mode undo would take back edits of the mesh alone, not the transform of the parent.
    """
    if context.mode == "EDIT_MESH":
        bpy.ops.object.mode_set(mode="OBJECT")
        return
    for thing in point_empties(context):
        thing.select_set(False)
