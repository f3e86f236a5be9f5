# SPDX-License-Identifier: GPL-3.0-or-later
"""Results as Blender objects with materials, and as .blend files."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import ResourceError, UsageError
from ..core.files import real_path
from ..core.texture.file_checks import ROUGHNESS, SPECULAR_LEVEL
from . import addon
from .cameras import create_camera, look_through, scale_display
from .mesh_data import build_mesh, mesh_of
from .placement import restore, scale_of
from .region_objects import create_region
from .result_files import MeshResult, RegionResult, ResultFiles, read_result

# -- Material of a result: the photo texture, lit or unlit, both exportable to glTF ---------------


_NORMAL_IMAGE, _NORMAL = "Normal Texture", "Normal Map"
_OCCLUSION_IMAGE, _OCCLUSION_RED, _OCCLUSION = "Occlusion Texture", "Occlusion Red", "glTF Output"
_GLTF_GROUP = "glTF Material Output"
"""Node group with the input ``Occlusion`` that Blender's glTF exporter reads; renders nothing."""
_IMAGE, _LIT, _UNLIT, _OUTPUT = "Photo Texture", "Lit", "Unlit", "Output"


def load_texture(path: Path, colorspace: str = "sRGB") -> bpy.types.Image:
    """Load an image by path (not packed), or reload it if already loaded.

    Normal maps are no colours: their ``colorspace`` is ``"Non-Color"``.
    """
    image = bpy.data.images.load(str(path), check_existing=True)
    if image.packed_file is not None:  # reloading would bring the packed one back
        image.unpack(method="REMOVE")
        image.reload()
        image.pack()
    elif image.users:
        image.reload()
    settings: Any = image.colorspace_settings
    settings.name = colorspace
    return image


def create_material(
    name: str,
    image: bpy.types.Image,
    normal_map: bpy.types.Image | None = None,
    occlusion: bpy.types.Image | None = None,
) -> bpy.types.Material:
    """Create a material with both branches, linked as lit; the lit one takes the further maps.

    Unlit is the node pattern that the glTF exporter writes as ``KHR_materials_unlit``.
    """
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # Blender 4 makes materials without nodes
        material.use_nodes = True
    tree: Any = material.node_tree
    nodes, links = tree.nodes, tree.links
    nodes.clear()
    texture = _new_node(nodes, "TexImage", (-600, 200), _IMAGE)
    texture.image = image
    lit = _new_node(nodes, "BsdfPrincipled", (-200, 400), _LIT)
    lit.inputs["Roughness"].default_value = ROUGHNESS
    lit.inputs["Specular IOR Level"].default_value = SPECULAR_LEVEL
    links.new(texture.outputs["Color"], lit.inputs["Base Color"])
    emission = _new_node(nodes, "Emission", (-200, -300))
    links.new(texture.outputs["Color"], emission.inputs["Color"])
    transparent = _new_node(nodes, "BsdfTransparent", (-200, -450))
    path = _new_node(nodes, "LightPath", (-600, -200))
    unlit = _new_node(nodes, "MixShader", (50, -300), _UNLIT)
    links.new(path.outputs["Is Camera Ray"], unlit.inputs[0])
    links.new(transparent.outputs[0], unlit.inputs[1])
    links.new(emission.outputs[0], unlit.inputs[2])
    output = _new_node(nodes, "OutputMaterial", (300, 200), _OUTPUT)
    links.new(lit.outputs[0], output.inputs["Surface"])
    # Workbench draws the texture of the active image node.
    nodes.active = texture
    set_normal_map(material, normal_map)
    set_occlusion(material, occlusion)
    return material


def _new_node(nodes: Any, kind: str, location: tuple[int, int], name: str = "") -> Any:
    node = nodes.new(f"ShaderNode{kind}")
    node.location = location
    if name:
        node.name = name
    return node


def _textured_mesh(name: str, made: MeshResult) -> bpy.types.Mesh:
    """Build a mesh with a material for each atlas: ``name``, then ``name 2`` and on."""
    mesh = build_mesh(name, made.vertices, made.faces, made.corner_uvs, made.face_atlas)
    for number, (image, normal_map, dark) in enumerate(_images_of(made), 1):
        called = f"{name} {number}" if number > 1 else name
        mesh.materials.append(create_material(called, image, normal_map, dark))
    return mesh


def _images_of(made: MeshResult) -> list[tuple[bpy.types.Image, Any, Any]]:
    """Load photo texture, normal map and occlusion of each atlas; the last two may be None."""
    none = [None] * len(made.albedo)
    normal_maps, dark = (
        [load_texture(path, "Non-Color") for path in paths] or none
        for paths in (made.normal_map, made.occlusion)
    )
    return list(zip(map(load_texture, made.albedo), normal_maps, dark, strict=True))


def set_normal_map(material: bpy.types.Material, image: bpy.types.Image | None) -> bool:
    """Set or remove the normal map of the lit branch; False if the material is not ours.

    The image goes through a Normal Map node, without which glTF exporters drop it.
    """
    tree: Any = material.node_tree
    if tree is None or _LIT not in tree.nodes:
        return False
    nodes, links = tree.nodes, tree.links
    if image is None:
        for name in (_NORMAL, _NORMAL_IMAGE):
            if name in nodes:
                nodes.remove(nodes[name])
        return True
    texture, normal = nodes.get(_NORMAL_IMAGE), nodes.get(_NORMAL)
    if texture is None or normal is None:
        set_normal_map(material, None)
        active = nodes.active
        texture = _new_node(nodes, "TexImage", (-900, 500), _NORMAL_IMAGE)
        normal = _new_node(nodes, "NormalMap", (-450, 500), _NORMAL)
        links.new(texture.outputs["Color"], normal.inputs["Color"])
        links.new(normal.outputs["Normal"], nodes[_LIT].inputs["Normal"])
        nodes.active = active  # Workbench draws the active image
    texture.image = image
    return True


def set_occlusion(material: bpy.types.Material, image: bpy.types.Image | None) -> bool:
    """Set or remove the occlusion map, for glTF; False if the material is not ours.

    Blender does not render it: its own lights make their own shadows.
    """
    tree: Any = material.node_tree
    if tree is None or _LIT not in tree.nodes:
        return False
    nodes, links = tree.nodes, tree.links
    for name in (_OCCLUSION, _OCCLUSION_RED, _OCCLUSION_IMAGE):
        if name in nodes:
            nodes.remove(nodes[name])
    if image is None:
        return True
    active = nodes.active
    texture = _new_node(nodes, "TexImage", (-600, 700), _OCCLUSION_IMAGE)
    texture.image = image
    red = _new_node(nodes, "SeparateColor", (-250, 700), _OCCLUSION_RED)
    group = _new_node(nodes, "Group", (50, 700), _OCCLUSION)
    group.node_tree = _gltf_group()
    links.new(texture.outputs["Color"], red.inputs["Color"])
    links.new(red.outputs["Red"], group.inputs["Occlusion"])
    nodes.active = active  # Workbench draws the active image
    return True


def _gltf_group() -> Any:
    groups: Any = bpy.data.node_groups
    group = groups.get(_GLTF_GROUP) or groups.new(_GLTF_GROUP, "ShaderNodeTree")
    if "Occlusion" not in group.interface.items_tree:
        group.interface.new_socket("Occlusion", in_out="INPUT", socket_type="NodeSocketFloat")
    return group


def set_shading(material: bpy.types.Material, shading: str) -> bool:
    """Link the lit or the unlit branch; False if the material is not ours."""
    tree = material.node_tree
    if tree is None or not {_LIT, _UNLIT, _OUTPUT} <= set(tree.nodes.keys()):
        return False
    source = tree.nodes[_LIT if shading == "LIT" else _UNLIT]
    tree.links.new(source.outputs[0], tree.nodes[_OUTPUT].inputs["Surface"])
    return True


def shading_of(material: bpy.types.Material | None) -> str | None:
    """Return ``"LIT"`` or ``"UNLIT"``, None if the material is not ours."""
    tree = material.node_tree if material is not None else None
    if tree is None or not {_LIT, _UNLIT, _OUTPUT} <= set(tree.nodes.keys()):
        return None
    links = tree.nodes[_OUTPUT].inputs["Surface"].links
    return "UNLIT" if links and links[0].from_node.name == _UNLIT else "LIT"


def show_as_emission(material: bpy.types.Material) -> None:
    """Turn one of our materials into a black Principled BSDF that emits the texture's colours.

    For formats without unlit materials: an approximation of ``Unlit`` that keeps the texture.
    """
    tree: Any = material.node_tree
    lit, texture = tree.nodes[_LIT], tree.nodes[_IMAGE]
    set_normal_map(material, None)
    for link in list(lit.inputs["Base Color"].links):
        tree.links.remove(link)
    lit.inputs["Base Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    lit.inputs["Specular IOR Level"].default_value = 0.0
    lit.inputs["Emission Strength"].default_value = 1.0
    tree.links.new(texture.outputs["Color"], lit.inputs["Emission Color"])
    set_shading(material, "LIT")


def fold_specular(material: bpy.types.Material) -> None:
    """Describe the reflectance of the lit branch by its index of refraction alone, as USD does.

    Blender's USD importer assumes a level of 0.5, which leaves the reflectance
    ((ior - 1) / (ior + 1))^2 unchanged; twice the level is a factor of it.
    """
    tree: Any = material.node_tree
    inputs = tree.nodes[_LIT].inputs
    level, index = inputs["Specular IOR Level"], inputs["IOR"]
    root = (
        abs(index.default_value - 1.0)
        / (index.default_value + 1.0)
        * math.sqrt(2.0 * min(max(level.default_value, 0.0), 0.5))
    )
    index.default_value, level.default_value = (1.0 + root) / (1.0 - root), 0.5


def texture_of(material: bpy.types.Material | None) -> bpy.types.Image | None:
    """Return the photo texture of one of our materials, else None."""
    tree: Any = material.node_tree if material is not None else None
    if tree is None or shading_of(material) is None:
        return None
    node = tree.nodes.get(_IMAGE)
    return None if node is None else node.image


def images_of(frame: bpy.types.Object | None) -> list[bpy.types.Image]:
    """Return the images in our materials on the meshes of a result, each once."""
    materials = _ours_on(frame.children_recursive if frame is not None else ())
    nodes = (node for material in materials for node in material.node_tree.nodes)
    images = (node.image for node in nodes if node.bl_idname == "ShaderNodeTexImage")
    return list(dict.fromkeys(image for image in images if image is not None))


def materials_of(frame: bpy.types.Object | None) -> list[bpy.types.Material]:
    """Return our materials on the meshes of a result, coarser and lighter ones included."""
    return list(dict.fromkeys(_ours_on(frame.children if frame is not None else ())))


def _ours_on(children: Iterable[bpy.types.Object]) -> list[Any]:
    meshes = [child for child in children if addon.kind_of(child) in addon.WITH_TEXTURE]
    materials = (slot.material for child in meshes for slot in child.material_slots)
    return [material for material in materials if shading_of(material) is not None]


# -- Levels of detail of a region, in a collection of their own; only the finest is shown ---------


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
    old = [t for t in levels if t.get(addon.REGION) == region.name]
    if old and all(c.get(addon.STAMP) == region.stamp for c in old):
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
        thing = bpy.data.objects.new(name, _textured_mesh(name, level))
        thing.parent = mesh.parent
        thing.matrix_basis = mesh.matrix_basis
        thing[addon.KIND] = "lod"
        thing[addon.REGION] = region.name
        thing[addon.LEVEL] = number
        thing[addon.STAMP] = region.stamp
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


# -- Create or update the Blender objects of a result folder --------------------------------------


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
    new = frame is None
    if frame is not None:
        _refuse_edited(files, frame)
    else:
        frame = bpy.data.objects.new(FRAME_NAME, None)
        frame.empty_display_type = "PLAIN_AXES"
        frame.empty_display_size = 0.2 * files.radius
        frame[addon.KIND] = "frame"
    frame[addon.RESULT] = str(files.folder)
    frame[addon.FINGERPRINT] = files.fingerprint
    frame[addon.WORLD_FROM_SCENE] = json.dumps(files.world_from_scene.to_json())
    frame[addon.FIGURES] = json.dumps(files.figures)
    collection = _collection_of(frame, files, scene)
    if new and files.placement is not None:
        restore(frame, files.placement)
    children = [c for c in bpy.data.objects if c.parent == frame and c.library is None]
    meshes, regions = [], []
    for region in files.regions:
        meshes.append(_update_mesh(region, children, frame, collection))
        box = _found(children, "region", region.name)
        if box is None:
            corners = files.world_from_scene.inverse().points(region.box_vertices)
            box = create_region(f"{region.name} region", corners, frame, collection)
            box[addon.REGION] = region.name
        regions.append(box)
    for thing in (*meshes, *regions):
        if not thing.users_collection:  # the user has deleted the collection, not its objects
            collection.objects.link(thing)
    cameras = _update_cameras(files, children, frame, collection)
    # Last: recreated levels leave dead entries among the children.
    for region, mesh in zip(files.regions, meshes, strict=True):
        levels = [c for c in frame.children if addon.kind_of(c) == "lod"]
        update_levels(region, mesh, levels, collection)
    return ImportedResult(collection, frame, tuple(meshes), cameras, tuple(regions))


def _refuse_edited(files: ResultFiles, frame: bpy.types.Object) -> None:
    """Refuse new geometry for a mesh in Edit Mode in another scene: Blender would not take it."""
    stamps = {region.name: region.stamp for region in files.regions}
    for thing in bpy.data.objects:
        if thing.parent != frame or addon.kind_of(thing) != "mesh" or thing.mode != "EDIT":
            continue
        if thing.get(addon.STAMP) != stamps.get(thing.get(addon.REGION), thing.get(addon.STAMP)):
            raise UsageError(
                f"{thing.name} is in Edit Mode, in another scene.",
                "Leave Edit Mode there, then import the result.",
            )


def _find_frame(files: ResultFiles, scene: bpy.types.Scene) -> bpy.types.Object | None:
    moved = None
    # The scene's own first: a full copy of a scene has a copy of the frame as well.
    own = set(scene.objects)
    for thing in sorted(bpy.data.objects, key=lambda t: t not in own):
        if addon.kind_of(thing) != "frame" or thing.library is not None:
            continue
        try:
            stored = addon.result_folder(thing)
        except UsageError:
            continue
        if real_path(stored) == files.folder:
            return thing
        if thing.get(addon.FINGERPRINT) == files.fingerprint and not stored.exists():
            moved = thing
    return moved


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


def _found(children: list[bpy.types.Object], kind: str, region: str) -> bpy.types.Object | None:
    found = (c for c in children if addon.kind_of(c) == kind and c.get(addon.REGION) == region)
    return next(found, None)


def _update_mesh(
    region: RegionResult,
    children: list[bpy.types.Object],
    frame: bpy.types.Object,
    collection: bpy.types.Collection,
) -> bpy.types.Object:
    thing = _found(children, "mesh", region.name)
    if thing is not None and thing.get(addon.STAMP) == region.stamp:
        return thing
    if thing is None:
        thing = bpy.data.objects.new(region.name, _textured_mesh(region.name, region.mesh))
        thing.parent = frame
        thing[addon.KIND] = "mesh"
        thing[addon.REGION] = region.name
        collection.objects.link(thing)
    else:
        old = mesh_of(thing)
        if thing.get(addon.BAKE):  # its material shows a bake onto the mesh that is replaced
            mesh = _textured_mesh(region.name, region.mesh)
            for tag in (addon.BAKE, addon.BAKE_NOTE):
                thing.pop(tag, None)
        else:
            made = region.mesh
            mesh = build_mesh(
                region.name, made.vertices, made.faces, made.corner_uvs, made.face_atlas
            )
            _keep_materials(list(old.materials), mesh, region)
        thing.data = mesh
        if old.users == 0:
            name = old.name
            bpy.data.meshes.remove(old)
            mesh.name = name
    thing[addon.STAMP] = region.stamp
    return thing


def _keep_materials(
    old: list[bpy.types.Material | None], mesh: bpy.types.Mesh, region: RegionResult
) -> None:
    """Assign the object's materials to new mesh data, and materials of further atlases.

    Slots of atlases that no longer exist stay if they contain a material of the user.
    """
    images = _images_of(region.mesh)
    for number, (image, normal_map, dark) in enumerate(images):
        if number < len(old):
            kept = old[number]
            mesh.materials.append(kept)
            if kept is not None:
                set_normal_map(kept, normal_map)
                set_occlusion(kept, dark)
        else:
            material = create_material(f"{region.name} {number + 1}", image, normal_map, dark)
            set_shading(material, shading_of(old[0] if old else None) or "LIT")
            mesh.materials.append(material)
    for further in old[len(images) :]:
        if shading_of(further) is None:
            mesh.materials.append(further)


def cameras_of(collection: bpy.types.Collection) -> bpy.types.Collection | None:
    """Return the collection of the photo cameras of a result, or None."""
    return next((c for c in collection.children if c.name.startswith(CAMERAS_NAME)), None)


def _update_cameras(
    files: ResultFiles,
    children: list[bpy.types.Object],
    frame: bpy.types.Object,
    collection: bpy.types.Collection,
) -> tuple[bpy.types.Object, ...]:
    known = {c.get(addon.PHOTO): c for c in children if addon.kind_of(c) == "camera"}
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


# -- Write a result as .blend and USD, in a Blender without a window ------------------------------


def write_blend(result_folder: Path, path: Path) -> None:
    """Write a .blend file of a result; images stay beside it, with relative paths.

    The file that is open in this Blender is closed without saving, so this is for background
    Blender only. Raises UsageError: Blender has a window, or the file cannot be written;
    DatasetError, ParseError: the folder contains no valid result.
    """
    path = path.resolve()
    start_empty("Writing a .blend file of a result")
    scene = bpy.context.scene
    imported = import_result(result_folder, scene)
    for thing in imported.regions:
        thing.hide_render = True
    if imported.cameras:
        look_through(scene, imported.cameras[0])
    world = bpy.data.worlds.new("World")
    world.color = (0.5, 0.5, 0.5)
    scene.world = world
    for screen in bpy.data.screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                view: Any = area.spaces.active
                view.shading.color_type = "TEXTURE"
    for image in bpy.data.images:
        if image.source == "FILE":
            image.filepath = _relative(Path(image.filepath), path.parent)
    imported.frame[addon.RESULT] = _relative(result_folder.resolve(), path.parent)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(path), relative_remap=False, check_existing=False)
    except RuntimeError as error:
        raise ResourceError(
            f"{path} cannot be written: {error}.", "Choose another folder."
        ) from None


def export_usd(result_folder: Path) -> list[Path]:
    """Write ``<region>/mesh.usdc`` for each region of a result, textures by relative path.

    Closes the open file, as :func:`write_blend` does.
    """
    start_empty("Writing USD")
    imported = import_result(result_folder, bpy.context.scene)
    options = {
        "selected_objects_only": True, "export_materials": True, "relative_paths": True,
        "export_textures": False,  # before Blender 4.4
        "export_textures_mode": "KEEP",  # since
    }  # fmt: skip
    usd_export: Any = bpy.ops.wm.usd_export
    known = usd_export.get_rna_type().properties.keys()
    paths = []
    bpy.context.view_layer.update()  # new objects cannot be selected before
    for mesh in imported.meshes:
        for slot in mesh.material_slots:
            if slot.material is not None:
                fold_specular(slot.material)
        for thing in bpy.context.view_layer.objects:
            thing.select_set(thing == mesh)
        path = result_folder.resolve() / mesh[addon.REGION] / "mesh.usdc"
        usd_export(filepath=str(path), **{k: v for k, v in options.items() if k in known})
        if not path.is_file():
            raise ResourceError(f"{path} cannot be written.", "Check the folder's permissions.")
        paths.append(path)
    return paths


def start_empty(purpose: str) -> None:
    """Close the open file without saving and begin an empty one; refuse if Blender has a window."""
    if not bpy.app.background:
        raise UsageError(f"{purpose} would close the open file.", "Do it in background Blender.")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


def _relative(path: Path, folder: Path) -> str:
    """Return a path in Blender's notation relative to a file in ``folder``."""
    try:
        return "//" + os.path.relpath(path, folder).replace("\\", "/")
    except ValueError:  # another Windows drive
        return str(path)
