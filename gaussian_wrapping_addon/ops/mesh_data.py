# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender mesh data from and to arrays."""

from __future__ import annotations

from typing import Any, cast

import bpy
import numpy as np

from ..core.errors import UsageError


def mesh_of(thing: bpy.types.Object) -> bpy.types.Mesh:
    """Return the data of a mesh object."""
    return cast(bpy.types.Mesh, thing.data)


def evaluated(thing: bpy.types.Object) -> bpy.types.Object:
    """Return an object with its modifiers applied.

    Raises UsageError: it has modifiers, and Blender does not evaluate them.
    """
    found = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if thing.modifiers and not found.is_evaluated:
        raise UsageError(
            f"The modifiers of {thing.name} are not evaluated: it is disabled in viewports, or in "
            "another scene.",
            "Enable it, or apply its modifiers.",
        )
    return found


def values_of(elements: Any, name: str, width: int, dtype: type) -> np.ndarray:
    """Return a property of all elements of a collection.

    Parameters
    ----------
    elements : bpy_prop_collection
        Of n elements.
    width : int
        Numbers of the property per element.

    Returns
    -------
    values : (n * width,) ndarray
    """
    values: np.ndarray = np.empty(width * len(elements), dtype)
    elements.foreach_get(name, values)
    return values


def build_mesh(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    corner_uvs: np.ndarray,
    face_material: np.ndarray | None = None,
) -> bpy.types.Mesh:
    """Build mesh data from arrays: smooth shaded, one UV layer, a material slot for each face.

    Parameters
    ----------
    vertices : (v, 3) ndarray
    faces : (f, 3) ndarray of int32
        Valid (``result_files.sound_faces``): Blender's own check takes longer than all the rest.
    corner_uvs : (f, 3, 2) ndarray of float32
    face_material : (f,) ndarray of int, optional
    """
    starts = np.arange(0, 3 * len(faces), 3)
    mesh = build_polygons(name, vertices, faces.ravel(), starts, corner_uvs.reshape(-1, 2))
    if face_material is not None:
        polygons: Any = mesh.polygons
        polygons.foreach_set("material_index", face_material.astype(np.int32))
    return mesh


def build_polygons(
    name: str,
    vertices: np.ndarray,
    corners: np.ndarray,
    starts: np.ndarray,
    uvs: np.ndarray | None = None,
) -> bpy.types.Mesh:
    """Build mesh data from arrays: smooth shaded, with one UV layer or none.

    Parameters
    ----------
    vertices : (v, 3) ndarray
    corners : (c,) ndarray of int
        Vertices of the polygons, one after another; valid as those of :func:`build_mesh`.
    starts : (p,) ndarray of int
        First corner of each polygon, ascending from 0.
    uvs : (c, 2) ndarray, optional
    """
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    mesh.loops.add(len(corners))
    mesh.polygons.add(len(starts))
    # Attributes are copied as one block, unlike the properties of vertices and loops.
    attributes: Any = mesh.attributes
    polygons: Any = mesh.polygons
    positions = np.ascontiguousarray(vertices, np.float32)
    attributes["position"].data.foreach_set("vector", positions.ravel())
    attributes[".corner_vert"].data.foreach_set("value", corners.astype(np.int32))
    polygons.foreach_set("loop_start", starts.astype(np.int32))
    if uvs is not None:
        layer: Any = mesh.uv_layers.new(name="UVMap", do_init=False)
        layer.uv.foreach_set("vector", uvs.astype(np.float32, copy=False).ravel())
    mesh.update(calc_edges=True)
    return mesh
