# SPDX-License-Identifier: GPL-3.0-or-later
"""Pick points of an imported scene, and see how it is placed."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np

from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.placement import FILE_NAME, read_placement
from gaussian_wrapping_addon.ops import addon, placement
from gaussian_wrapping_addon.ops.region_objects import matrix_of, region_body, transformed
from gaussian_wrapping_addon.ops.scene_objects import ImportedResult
from tests.blender.synthetic_result import WORLD_FROM_SCENE
from tests.poses import look_at_pose


def upright_cameras() -> list[dict]:
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        pose = look_at_pose([4 * np.cos(angle), 4 * np.sin(angle), 2.0])
        cameras.append(
            {
                "name": f"{angle:.2f}.jpg", "width": 64, "height": 48, "fx": 50.0, "fy": 50.0,
                "cx": 32.0, "cy": 24.0, "cam_from_world": pose.tolist(),
                "photo": f"/nowhere/{angle:.2f}.jpg",
            }
        )  # fmt: skip
    return cameras


def stored(imported: ImportedResult) -> Similarity | None:
    path = addon.result_folder(imported.frame) / FILE_NAME
    return read_placement(path, WORLD_FROM_SCENE) if path.exists() else None


def state(imported: ImportedResult) -> list:
    """Everything of the children that a tool must leave alone."""
    found: list = [[v.co[:] for m in imported.meshes for v in m.data.vertices]]
    for thing in (*imported.meshes, *imported.cameras, *imported.regions):
        found.append((thing.name, [tuple(row) for row in thing.matrix_basis]))
    return found


def pick_vertices(thing: bpy.types.Object, indices: list[int]) -> None:
    bpy.context.view_layer.objects.active = thing
    bpy.ops.object.mode_set(mode="EDIT")
    work = bmesh.from_edit_mesh(thing.data)
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.context.tool_settings.mesh_select_mode = (True, False, False)
    work.verts.ensure_lookup_table()
    for index in indices:
        work.verts[index].select = True
    bmesh.update_edit_mesh(thing.data)


def put_points(places: np.ndarray) -> None:
    for place in places:
        bpy.context.scene.cursor.location = place
        assert bpy.ops.gwrap.add_point() == {"FINISHED"}


def in_blender(imported: ImportedResult, vertex: int) -> np.ndarray:
    thing = imported.meshes[0]
    local = np.array(thing.data.vertices[vertex].co, np.float64)
    return transformed(matrix_of(thing), local[None])[0]


def same_matrix(frame: bpy.types.Object, expected: Similarity) -> bool:
    return bool(np.allclose(matrix_of(frame), expected.matrix(), rtol=1e-5, atol=1e-5))


def tilt(imported: ImportedResult) -> Similarity:
    """Move the parent by hand."""
    frame = imported.frame
    frame.location, frame.rotation_euler, frame.scale = (3, -2, 1), (0.3, -0.4, 0.5), (2, 2, 2)
    bpy.context.view_layer.update()
    return placement.placement_of(frame)


def region_from_object(thing: bpy.types.Object) -> np.ndarray:
    """Return the (n, 3) float64 hull of a region object in the world of the input."""
    return np.array(region_body(thing)["vertices"])
