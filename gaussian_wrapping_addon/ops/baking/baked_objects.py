# SPDX-License-Identifier: GPL-3.0-or-later
"""Bring a finished bake into the scene: material and UVs of the object, or an object of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bmesh
import bpy
import numpy as np

from ...core.errors import UsageError
from ...core.mesh.polygons import SAME_UV, join_triangles
from ..common import tags
from ..common.mesh_data import build_mesh, build_polygons, mesh_of
from ..results.materials import (
    create_material,
    load_texture,
    set_occlusion,
    set_shading,
    shading_of,
)
from .baked_files import BakedFiles
from .triangulation import Triangulation, scene_points, triangulation_of

UV_NAME = "Photos"
"""UV map made for a bake."""
MOVED_SHARE = 1e-4
"""Share of the mesh's extent by which corners may have moved since they were handed over."""
SUFFIXES = {"KEEP": "", "DECIMATE": " light", "QUADS": " quads"}
"""What the names of objects that bakes make end with, by the choice *Faces*."""


def apply_bake(
    scene: bpy.types.Scene, frame: bpy.types.Object, baked: BakedFiles, target_uid: int = 0
) -> bpy.types.Object:
    """Show a bake in a scene; return the object that shows it.

    The object gets the baked material in place of its own, and new UVs as a UV map of their own.
    Polygons that new UVs cut are divided; all others stay. A bake with fewer faces or with quads
    becomes a new object under the frame, and the dense one is hidden.

    Parameters
    ----------
    scene : Scene
    frame : Object
        Frame of the result whose photos were baked.
    baked : BakedFiles
    target_uid : int, optional
        Session uid of the object that was handed over; otherwise it is found by its tag.

    Raises
    ------
    UsageError
        The object is gone, or its faces have changed since; nothing has been changed.
    """
    thing = _target(scene, baked.name, target_uid)
    if not baked.has_own_faces or baked.polygons is not None:
        thing = _new_object(scene, frame, thing, baked)
    else:
        if thing is None:
            raise UsageError(
                f"The object that {baked.name} was baked for is not in the scene.",
                "Undo its removal and press Bake Photos again: what is baked already is used.",
            )
        if not baked.has_own_uvs:
            _set_uvs(thing, frame, baked)
        _set_material(thing, frame, baked)
        _use_active_uvs(mesh_of(thing))
    thing[tags.BAKE] = baked.name
    note = f"{100 * baked.coverage:.1f} % seen by photos"
    thing[tags.BAKE_NOTE] = " ".join([f"{note}.", *baked.warnings])
    return thing


def _target(scene: bpy.types.Scene, name: str, uid: int) -> bpy.types.Object | None:
    objects = [thing for thing in scene.objects if thing.type == "MESH"]
    found = [thing for thing in objects if uid and thing.session_uid == uid]
    tagged = [t for t in objects if t.get(tags.BAKE) == name and tags.kind_of(t) != "baked"]
    return next(iter((*found, *tagged)), None)


def _new_object(
    scene: bpy.types.Scene,
    frame: bpy.types.Object,
    dense: bpy.types.Object | None,
    baked: BakedFiles,
) -> bpy.types.Object:
    known = (t for t in scene.objects if tags.kind_of(t) == "baked")
    thing = next((t for t in known if t.get(tags.BAKE) == baked.name), None)
    name = f"{dense.name}{SUFFIXES[_retopology(baked)]}" if dense else baked.name
    if baked.polygons is None:
        mesh = build_mesh(name, baked.vertices, baked.faces, baked.corner_uvs)
    else:
        joined = join_triangles(baked.faces, baked.corner_uvs, baked.polygons)
        mesh = build_polygons(name, baked.vertices, joined.corners, joined.starts, joined.uvs)
        mesh.validate()
    if thing is None:
        thing = bpy.data.objects.new(name, mesh)
        thing[tags.KIND] = "baked"
        thing.parent = frame
        collection = frame.users_collection[0] if frame.users_collection else scene.collection
        if dense is not None and dense.users_collection:
            collection = dense.users_collection[0]
        collection.objects.link(thing)
    else:
        old, thing.data = mesh_of(thing), mesh
        if old.users == 0:
            bpy.data.meshes.remove(old)
    _set_material(thing, frame, baked)
    if dense is not None:
        _stand_in(thing, dense)
    return thing


def _stand_in(thing: bpy.types.Object, dense: bpy.types.Object) -> None:
    """Show an object and hide its dense mesh; where that was active, it is instead, selected."""
    layer = bpy.context.view_layer
    layer.update()  # or it does not have an object that was linked just now
    is_there = thing.name in layer.objects
    if is_there:
        thing.hide_set(False)
    was_active = layer.objects.active == dense and dense.mode == "OBJECT"
    dense.hide_set(True)
    dense.hide_render = True
    if was_active and is_there:
        thing.select_set(True)
        layer.objects.active = thing


def _retopology(baked: BakedFiles) -> str:
    return "DECIMATE" if baked.polygons is None else "QUADS"


def _set_uvs(thing: bpy.types.Object, frame: bpy.types.Object, baked: BakedFiles) -> None:
    triangles = triangulation_of(thing)
    _refuse_changed(thing, frame, triangles, baked)
    if mesh_of(thing).users > 1:
        thing.data = mesh_of(thing).copy()  # its other users are somewhere else
    mesh = mesh_of(thing)
    corners = triangles.loops.ravel()
    uvs = baked.corner_uvs.reshape(-1, 2)
    of_loops = np.zeros((len(mesh.loops), 2), np.float32)
    of_loops[corners] = uvs
    apart = (np.abs(of_loops[corners] - uvs) > SAME_UV).any(axis=1).reshape(-1, 3).any(axis=1)
    layer: Any = mesh.uv_layers.get(UV_NAME) or mesh.uv_layers.new(name=UV_NAME, do_init=False)
    if layer is None:
        raise UsageError(
            f"{thing.name} has as many UV maps as Blender allows.", "Remove one of them."
        )
    mesh.uv_layers.active = layer
    layer.uv.foreach_set("vector", of_loops.ravel())
    cut = np.unique(triangles.polygons[apart])
    if len(cut):
        _divide(mesh, triangles, baked.corner_uvs, cut)
    mesh.update()


def _refuse_changed(
    thing: bpy.types.Object,
    frame: bpy.types.Object,
    triangles: Triangulation,
    baked: BakedFiles,
) -> None:
    same = triangles.is_own and triangles.faces.shape == baked.faces.shape
    if same:
        now = scene_points(frame, triangles.vertices)[triangles.faces]
        before = baked.vertices[baked.faces]
        extent = float(np.ptp(before.reshape(-1, 3), axis=0).max())
        # Moved, turned or scaled as a whole, it is the same mesh.
        same = _shape_differs(now, before) <= MOVED_SHARE * extent
    if not same:
        raise UsageError(
            f"{thing.name} has changed since its photos were baked.", "Press Bake Photos again."
        )


def _shape_differs(now: np.ndarray, before: np.ndarray) -> float:
    """Return how far the lengths of edges differ, in the unit of ``before``."""
    edges = [np.linalg.norm(c - np.roll(c, -1, axis=1), axis=2).ravel() for c in (now, before)]
    scale = float(edges[1].sum() / max(edges[0].sum(), 1e-300))
    return float(np.abs(scale * edges[0] - edges[1]).max())


def _divide(
    mesh: bpy.types.Mesh, triangles: Triangulation, corner_uvs: np.ndarray, cut: np.ndarray
) -> None:
    """Divide polygons into their triangles, whose corners have UVs of their own."""
    work = bmesh.new()
    try:
        work.from_mesh(mesh)
        work.faces.ensure_lookup_table()
        layers: Any = work.loops.layers.uv
        layer = layers[UV_NAME]
        rows = np.flatnonzero(np.isin(triangles.polygons, cut))
        first = {int(p): int(mesh.polygons[int(p)].loop_start) for p in cut}
        old = {int(p): work.faces[int(p)] for p in cut}
        for row in rows.tolist():
            polygon = int(triangles.polygons[row])
            face = old[polygon]
            loops = [face.loops[int(k) - first[polygon]] for k in triangles.loops[row]]
            try:
                new = work.faces.new([loop.vert for loop in loops], face)
            except ValueError:
                continue  # Blender has this triangle already: a face folded onto itself
            for loop, before, uv in zip(new.loops, loops, corner_uvs[row], strict=True):
                _copy_layers(work.loops.layers, before, loop)
                loop[layer].uv = uv.tolist()
        bmesh.ops.delete(work, geom=list(old.values()), context="FACES_ONLY")
        work.to_mesh(mesh)
    finally:
        work.free()


def _copy_layers(layers: Any, source: Any, target: Any) -> None:
    """Copy a corner's UVs, colours and attributes; ``BMLoop.copy_from`` breaks in Blender 4.3."""
    for layer in layers.uv.values():
        target[layer].uv = source[layer].uv
    for kind in ("color", "float_color", "float", "float_vector", "int", "bool", "string"):
        for layer in getattr(layers, kind).values() if hasattr(layers, kind) else ():
            target[layer] = source[layer]


def _set_material(thing: bpy.types.Object, frame: bpy.types.Object, baked: BakedFiles) -> None:
    image = _load(baked.albedo, baked.udims, "sRGB")
    normal = _load(baked.normal_map, baked.udims, "Non-Color") if baked.normal_map else None
    dark = _load(baked.occlusion, baked.udims, "Non-Color") if baked.occlusion else None
    mesh = mesh_of(thing)
    if mesh.users > 1:
        thing.data = mesh = mesh.copy()
    material = create_material(f"{thing.name} photos", image, normal)
    set_occlusion(material, dark)
    set_shading(material, _shading(frame))
    mesh.materials.clear()
    mesh.materials.append(material)
    polygons: Any = mesh.polygons
    polygons.foreach_set("material_index", np.zeros(len(mesh.polygons), np.int32))
    for slot in thing.material_slots:
        slot.link = "DATA"


def _shading(frame: bpy.types.Object) -> str:
    """Return how the result's own meshes are shaded, so that both look alike."""
    for child in frame.children:
        for slot in child.material_slots if tags.kind_of(child) == "mesh" else ():
            shading = shading_of(slot.material)
            if shading is not None:
                return shading
    return "LIT"


def _load(paths: Sequence[Path], udims: Sequence[int], colorspace: str) -> bpy.types.Image:
    if not udims:
        return load_texture(paths[0], colorspace)
    pattern = str(paths[0]).replace(f".{udims[0]}.", ".<UDIM>.")
    known = (i for i in bpy.data.images if i.source == "TILED" and i.filepath == pattern)
    image = next(known, None) or bpy.data.images.load(str(paths[0]), check_existing=False)
    image.source = "TILED"
    image.filepath = pattern
    image.name = Path(pattern).name
    tiles: Any = image.tiles
    tiles[0].number = udims[0]
    there = {tile.number for tile in tiles}
    for number in udims:
        if number not in there:
            tiles.new(tile_number=number)
    for tile in list(tiles):
        if tile.number not in udims:
            tiles.remove(tile)
    image.reload()
    settings: Any = image.colorspace_settings
    settings.name = colorspace
    return image


def _use_active_uvs(mesh: bpy.types.Mesh) -> None:
    """Render with the UV map that photos were baked for: the active one."""
    layer = mesh.uv_layers.active
    if layer is not None:
        layer.active_render = True
