# SPDX-License-Identifier: GPL-3.0-or-later
"""Create or update the Blender objects of a result folder."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...core.errors import UsageError
from ...core.files import real_path
from ..cameras.camera_objects import create_camera, scale_display
from ..common import tags
from ..common.mesh_data import build_mesh, mesh_of
from ..placement.placement import restore, scale_of
from ..regions.region_objects import create_region
from .level_objects import update_levels
from .materials import (
    create_material,
    create_materials,
    load_data_maps,
    load_texture,
    set_normal_map,
    set_occlusion,
    set_shading,
    shading_of,
)
from .result_files import RegionResult, ResultFiles, read_result

FRAME_NAME = "blender_from_scene"
CAMERAS_NAME = "Photo Cameras"

# Camera frusta this share of the scene's radius are visible and do not hide the mesh.
_CAMERA_SIZE_SHARE = 0.03


@dataclass(frozen=True)
class ImportedResult:
    """The objects of one result, new and existing."""

    collection: bpy.types.Collection
    frame: bpy.types.Object
    """The parent empty; its matrix is ``blender_from_scene`` (``placement.py``)."""
    meshes: tuple[bpy.types.Object, ...]
    cameras: tuple[bpy.types.Object, ...]
    regions: tuple[bpy.types.Object, ...]


def import_result(
    folder: Path, scene: bpy.types.Scene, files: ResultFiles | None = None
) -> ImportedResult:
    """Create or update the objects of a result folder.

    A result that was placed before (``placement.json``) is placed so again. One that was imported
    before is found again by its folder; then meshes whose file has changed get the new geometry,
    what is missing is added, and everything else, such as the transforms, modifiers and materials
    of the user, stays.

    Parameters
    ----------
    folder : Path
        ``DIR/result`` (docs/architecture.md).
    scene : Scene
        Where new objects are linked.
    files : ResultFiles, optional
        The content of the folder if it has been read already.

    Raises
    ------
    DatasetError, ParseError
        The folder contains no valid result; nothing has been changed.
    UsageError
        A mesh that has changed is in Edit Mode in another scene; nothing has been changed.
    """
    files = files or read_result(folder)
    frame = _find_frame(files, scene)
    if frame is not None:
        _refuse_edited(files, frame)
    new = frame is None
    if frame is None:
        frame = _create_frame(files)
    frame[tags.RESULT] = str(files.folder)
    frame[tags.FINGERPRINT] = files.fingerprint
    frame[tags.WORLD_FROM_SCENE] = json.dumps(files.world_from_scene.to_json())
    frame[tags.FIGURES] = json.dumps(files.figures)
    collection = _collection_of(frame, files, scene)
    if new and files.placement is not None:
        restore(frame, files.placement)
    children = [c for c in bpy.data.objects if c.parent == frame and c.library is None]
    meshes, regions = [], []
    for region in files.regions:
        meshes.append(_update_mesh(region, children, frame, collection))
        regions.append(_update_region(region, files, children, frame, collection))
    for thing in (*meshes, *regions):
        if not thing.users_collection:  # the user has deleted the collection, not its objects
            collection.objects.link(thing)
    cameras = _update_cameras(files, children, frame, collection)
    # Last: recreated levels leave dead entries among the children.
    for region, mesh in zip(files.regions, meshes, strict=True):
        levels = [c for c in frame.children if tags.kind_of(c) == "lod"]
        update_levels(region, mesh, levels, collection)
    return ImportedResult(collection, frame, tuple(meshes), cameras, tuple(regions))


def _refuse_edited(files: ResultFiles, frame: bpy.types.Object) -> None:
    """Refuse new geometry for a mesh in Edit Mode in another scene: Blender would not take it."""
    stamps = {region.name: region.stamp for region in files.regions}
    for thing in bpy.data.objects:
        if thing.parent != frame or tags.kind_of(thing) != "mesh" or thing.mode != "EDIT":
            continue
        if thing.get(tags.STAMP) != stamps.get(thing.get(tags.REGION), thing.get(tags.STAMP)):
            raise UsageError(
                f"{thing.name} is in Edit Mode, in another scene.",
                "Leave Edit Mode there, then import the result.",
            )


def _find_frame(files: ResultFiles, scene: bpy.types.Scene) -> bpy.types.Object | None:
    moved = None
    # The scene's own first: a full copy of a scene has a copy of the frame as well.
    own = set(scene.objects)
    for thing in sorted(bpy.data.objects, key=lambda t: t not in own):
        if tags.kind_of(thing) != "frame" or thing.library is not None:
            continue
        try:
            stored = tags.result_folder(thing)
        except UsageError:
            continue
        if real_path(stored) == files.folder:
            return thing
        if thing.get(tags.FINGERPRINT) == files.fingerprint and not stored.exists():
            moved = thing
    return moved


def _create_frame(files: ResultFiles) -> bpy.types.Object:
    frame = bpy.data.objects.new(FRAME_NAME, None)
    frame.empty_display_type = "PLAIN_AXES"
    frame.empty_display_size = 0.2 * files.radius
    frame[tags.KIND] = "frame"
    return frame


def _collection_of(
    frame: bpy.types.Object, files: ResultFiles, scene: bpy.types.Scene
) -> bpy.types.Collection:
    """Return the collection that holds the frame, linked to the scene."""
    if frame.users_collection:
        collection = frame.users_collection[0]
    else:
        collection = bpy.data.collections.new(files.folder.parent.name or "Gaussian Wrapping")
        collection.objects.link(frame)
    if collection != scene.collection and collection not in scene.collection.children_recursive:
        scene.collection.children.link(collection)
    return collection


def _found(
    children: list[bpy.types.Object], kind: str, key: str, value: str
) -> bpy.types.Object | None:
    return next((c for c in children if tags.kind_of(c) == kind and c.get(key) == value), None)


def _update_mesh(
    region: RegionResult,
    children: list[bpy.types.Object],
    frame: bpy.types.Object,
    collection: bpy.types.Collection,
) -> bpy.types.Object:
    thing = _found(children, "mesh", tags.REGION, region.name)
    if thing is not None and thing.get(tags.STAMP) == region.stamp:
        return thing
    mesh = build_mesh(
        region.name, region.vertices, region.faces, region.corner_uvs, region.face_atlas
    )
    if thing is None:
        for material in create_materials(
            region.name, region.albedo, region.normal_map, region.occlusion
        ):
            mesh.materials.append(material)
        thing = bpy.data.objects.new(region.name, mesh)
        thing.parent = frame
        thing[tags.KIND] = "mesh"
        thing[tags.REGION] = region.name
        collection.objects.link(thing)
    else:
        old = mesh_of(thing)
        if thing.get(tags.BAKE):  # its material shows a bake onto the mesh that is replaced
            for material in create_materials(
                region.name, region.albedo, region.normal_map, region.occlusion
            ):
                mesh.materials.append(material)
            for tag in (tags.BAKE, tags.BAKE_NOTE):
                thing.pop(tag, None)
        else:
            _keep_materials(list(old.materials), mesh, region)
        thing.data = mesh
        if old.users == 0:
            name = old.name
            bpy.data.meshes.remove(old)
            mesh.name = name
    thing[tags.STAMP] = region.stamp
    return thing


def _keep_materials(
    old: list[bpy.types.Material | None], mesh: bpy.types.Mesh, region: RegionResult
) -> None:
    """Assign the object's materials to new mesh data, and materials of further atlases.

    Slots of atlases that no longer exist stay if they contain a material of the user.
    """
    images = [load_texture(path) for path in region.albedo]
    normals = load_data_maps(region.normal_map, len(images))
    dark = load_data_maps(region.occlusion, len(images))
    for number, (image, normal_map) in enumerate(zip(images, normals, strict=True)):
        if number < len(old):
            kept = old[number]
            mesh.materials.append(kept)
            if kept is not None:
                set_normal_map(kept, normal_map)
                set_occlusion(kept, dark[number])
        else:
            name = f"{region.name} {number + 1}"
            material = create_material(name, image, normal_map)
            set_occlusion(material, dark[number])
            set_shading(material, shading_of(old[0] if old else None) or "LIT")
            mesh.materials.append(material)
    for further in old[len(images) :]:
        if shading_of(further) is None:
            mesh.materials.append(further)


def _update_region(
    region: RegionResult,
    files: ResultFiles,
    children: list[bpy.types.Object],
    frame: bpy.types.Object,
    collection: bpy.types.Collection,
) -> bpy.types.Object:
    thing = _found(children, "region", tags.REGION, region.name)
    if thing is None:
        vertices = files.world_from_scene.inverse().points(region.box_vertices)
        thing = create_region(f"{region.name} region", vertices, frame, collection)
        thing[tags.REGION] = region.name
    return thing


def cameras_of(collection: bpy.types.Collection) -> bpy.types.Collection | None:
    """Return the collection of the photo cameras of a result, or None."""
    return next((c for c in collection.children if c.name.startswith(CAMERAS_NAME)), None)


def _update_cameras(
    files: ResultFiles,
    children: list[bpy.types.Object],
    frame: bpy.types.Object,
    collection: bpy.types.Collection,
) -> tuple[bpy.types.Object, ...]:
    known = {c.get(tags.PHOTO): c for c in children if tags.kind_of(c) == "camera"}
    folder = cameras_of(collection)
    scale = scale_of(frame)
    cameras = []
    for camera, photo in files.cameras:
        thing = known.get(photo)
        if thing is None:
            if folder is None:
                folder = bpy.data.collections.new(CAMERAS_NAME)
                folder.hide_viewport = True  # a hundred cameras would hide the mesh
                collection.children.link(folder)
            thing = create_camera(camera, photo, _CAMERA_SIZE_SHARE * files.radius, folder)
            thing.parent = frame
            scale_display(thing, scale)
        cameras.append(thing)
    return tuple(cameras)
