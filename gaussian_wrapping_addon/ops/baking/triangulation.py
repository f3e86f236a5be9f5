# SPDX-License-Identifier: GPL-3.0-or-later
"""A mesh object as triangles, with its modifiers, in the world of a job's input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ...core.errors import UsageError
from ...core.mesh.exchange.mesh_reader import FileMesh
from ...core.mesh.polygons import Polygons
from ..common import tags
from ..common.mesh_data import evaluated, mesh_of, values_of
from ..placement.placement import placement_of
from ..regions.region_objects import matrix_of, transformed


@dataclass(frozen=True)
class Triangulation:
    """Triangles of an evaluated mesh object."""

    vertices: np.ndarray
    """(v, 3) float64, Blender's world."""
    faces: np.ndarray
    """(f, 3) int32, counter-clockwise seen from outside, also of a mirrored object."""
    loops: np.ndarray
    """(f, 3) int32 loop of each corner."""
    polygons: np.ndarray
    """(f,) int32 polygon of each triangle."""
    corner_uvs: np.ndarray | None
    """(f, 3, 2) float32 of the active UV map; ``None`` without one."""
    is_own: bool
    """Whether these are the loops of the object's own mesh: no modifier has changed its faces."""


def triangulation_of(thing: bpy.types.Object) -> Triangulation:
    """Triangulate a mesh object as it is shown.

    Raises
    ------
    UsageError
        It is no mesh, is not evaluated, has no faces, or has vertices that are not finite.
    """
    if thing.type != "MESH":
        raise UsageError(f"{thing.name} is no mesh.", "Select a mesh object.")
    mesh_of(thing).update_tag()  # scripts may have changed its layers, which tags nothing
    shown = evaluated(thing)
    mesh = shown.to_mesh()
    try:
        mesh.calc_loop_triangles()
        local = values_of(mesh.vertices, "co", 3, np.float32).reshape(-1, 3)
        triangles: Any = mesh.loop_triangles
        faces = values_of(triangles, "vertices", 3, np.int32).reshape(-1, 3)
        loops = values_of(triangles, "loops", 3, np.int32).reshape(-1, 3)
        polygons = values_of(triangles, "polygon_index", 1, np.int32)
        layer: Any = mesh.uv_layers.active
        uvs = None if layer is None else values_of(layer.uv, "vector", 2, np.float32).reshape(-1, 2)
        is_own = _same_faces(mesh, mesh_of(thing))
    finally:
        shown.to_mesh_clear()
    if len(faces) == 0:
        raise UsageError(f"{thing.name} has no faces.", "Select a mesh with faces.")
    matrix = matrix_of(thing)
    vertices = transformed(matrix, local.astype(np.float64))
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise UsageError(
            f"Vertex {int(bad[0])} of {thing.name} is not finite (as are {len(bad)} in all).",
            "Delete these vertices, or check the object's scale.",
        )
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        faces, loops = faces[:, [0, 2, 1]], loops[:, [0, 2, 1]]
    corner_uvs = None if uvs is None else uvs[loops]
    return Triangulation(vertices, faces, loops, polygons, corner_uvs, is_own)


def _same_faces(evaluated: bpy.types.Mesh, own: bpy.types.Mesh) -> bool:
    if (len(evaluated.loops), len(evaluated.polygons)) != (len(own.loops), len(own.polygons)):
        return False
    corners = [values_of(mesh.loops, "vertex_index", 1, np.int32) for mesh in (evaluated, own)]
    starts = [values_of(mesh.polygons, "loop_start", 1, np.int32) for mesh in (evaluated, own)]
    return bool(np.array_equal(corners[0], corners[1]) and np.array_equal(starts[0], starts[1]))


def scene_points(frame: bpy.types.Object, vertices: np.ndarray) -> np.ndarray:
    """Bring (n, 3) points of Blender's world into the scene frame of a result.

    Raises
    ------
    UsageError
        The frame is scaled differently along its axes, mirrored or has no size.
    """
    return placement_of(frame).inverse().points(vertices)


def world_mesh(
    frame: bpy.types.Object,
    triangles: Triangulation,
    *,
    with_uvs: bool = False,
    with_polygons: bool = False,
) -> FileMesh:
    """Return a mesh in the world of the input, wherever the result and the object stand.

    Parameters
    ----------
    with_uvs, with_polygons : bool
        Whether it has the UVs of the triangles, and what these are parts of.

    Raises
    ------
    UsageError
        The frame has no valid transform, or has lost its world coordinates.
    """
    world = tags.world_from_scene(frame).points(scene_points(frame, triangles.vertices))
    polygons = Polygons(triangles.polygons.astype(np.int64), triangles.loops.astype(np.int64))
    return FileMesh(
        world, triangles.faces, triangles.corner_uvs if with_uvs else None,
        polygons if with_polygons else None,
    )  # fmt: skip
