# SPDX-License-Identifier: GPL-3.0-or-later
"""Levels of detail of a region, in a collection of their own; only the finest is shown."""

from __future__ import annotations

import bpy

from ..common import tags
from ..common.mesh_data import build_mesh, mesh_of
from .materials import create_materials
from .result_files import RegionResult


def update_levels(
    region: RegionResult,
    mesh: bpy.types.Object,
    levels: list[bpy.types.Object],
    collection: bpy.types.Collection,
) -> tuple[bpy.types.Object, ...]:
    """Update the coarser levels of a region.

    Levels are replaced when the region's mesh has changed: they are made from it. The region's own
    object is level 0; it moves into the levels' collection, unless the user has put it elsewhere.

    Parameters
    ----------
    region : RegionResult
    mesh : Object
        The region's mesh object, up to date; its parent is that of the levels.
    levels : list of Object
        All levels of the result; those of other regions are left alone.
    collection : Collection
        The result's collection, parent of that of the levels.
    """
    old = [t for t in levels if t.get(tags.REGION) == region.name]
    if old and all(c.get(tags.STAMP) == region.stamp for c in old):
        return tuple(old)
    # If the user has put them into another collection, they stay there.
    folder = old[0].users_collection[0] if old and old[0].users_collection else None
    for thing in old:
        _remove(thing)
    if not region.levels:
        return ()
    if folder is None:
        folder = bpy.data.collections.new(f"{region.name} LODs")
        collection.children.link(folder)
        if mesh.users_collection == (collection,):
            collection.objects.unlink(mesh)
            folder.objects.link(mesh)
            if mesh.name == region.name:
                mesh.name = f"{region.name} LOD0"
    made = []
    for number, level in enumerate(region.levels, 1):
        name = f"{region.name} LOD{number}"
        data = build_mesh(name, level.vertices, level.faces, level.corner_uvs, level.face_atlas)
        for material in create_materials(name, level.albedo, level.normal_map, level.occlusion):
            data.materials.append(material)
        thing = bpy.data.objects.new(name, data)
        thing.parent = mesh.parent
        thing.matrix_basis = mesh.matrix_basis
        thing[tags.KIND] = "lod"
        thing[tags.REGION] = region.name
        thing[tags.LEVEL] = number
        thing[tags.STAMP] = region.stamp
        thing.hide_viewport = thing.hide_render = True
        folder.objects.link(thing)
        made.append(thing)
    return tuple(made)


def _remove(thing: bpy.types.Object) -> None:
    """Delete a level with its mesh and material, unless something else uses them."""
    data = mesh_of(thing)
    materials = [m for m in data.materials if m is not None]
    bpy.data.objects.remove(thing)
    if data.users == 0:
        bpy.data.meshes.remove(data)
    for material in materials:
        if material.users == 0:
            bpy.data.materials.remove(material)
