# SPDX-License-Identifier: GPL-3.0-or-later
"""Material of a result: the photo texture, lit or unlit, both exportable to glTF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy

from ...core.texture.files.shading import ROUGHNESS, SPECULAR_LEVEL
from ..common import tags

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
    name: str, image: bpy.types.Image, normal_map: bpy.types.Image | None = None
) -> bpy.types.Material:
    """Create a material with both branches, linked as lit; the lit one takes the normal map.

    Unlit is the node pattern that the glTF exporter writes as ``KHR_materials_unlit``.
    """
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # Blender 4 makes materials without nodes
        material.use_nodes = True
    tree: Any = material.node_tree
    nodes, links = tree.nodes, tree.links
    nodes.clear()
    texture = nodes.new("ShaderNodeTexImage")
    texture.name, texture.image, texture.location = _IMAGE, image, (-600, 200)
    lit = nodes.new("ShaderNodeBsdfPrincipled")
    lit.name, lit.location = _LIT, (-200, 400)
    lit.inputs["Roughness"].default_value = ROUGHNESS
    lit.inputs["Specular IOR Level"].default_value = SPECULAR_LEVEL
    links.new(texture.outputs["Color"], lit.inputs["Base Color"])
    emission = nodes.new("ShaderNodeEmission")
    emission.location = (-200, -300)
    links.new(texture.outputs["Color"], emission.inputs["Color"])
    transparent = nodes.new("ShaderNodeBsdfTransparent")
    transparent.location = (-200, -450)
    path = nodes.new("ShaderNodeLightPath")
    path.location = (-600, -200)
    unlit = nodes.new("ShaderNodeMixShader")
    unlit.name, unlit.location = _UNLIT, (50, -300)
    links.new(path.outputs["Is Camera Ray"], unlit.inputs[0])
    links.new(transparent.outputs[0], unlit.inputs[1])
    links.new(emission.outputs[0], unlit.inputs[2])
    output = nodes.new("ShaderNodeOutputMaterial")
    output.name, output.location = _OUTPUT, (300, 200)
    links.new(lit.outputs[0], output.inputs["Surface"])
    # Workbench draws the texture of the active image node.
    nodes.active = texture
    set_normal_map(material, normal_map)
    return material


def create_materials(
    name: str,
    albedo: Sequence[Path],
    normal_map: Sequence[Path],
    occlusion: Sequence[Path] = (),
) -> list[bpy.types.Material]:
    """Create a material for each atlas: ``name``, then ``name 2`` and on.

    Parameters
    ----------
    albedo, normal_map, occlusion : sequence of Path
        Images, one for each atlas; the last two may be empty.
    """
    normals = load_data_maps(normal_map, len(albedo))
    dark = load_data_maps(occlusion, len(albedo))
    materials = []
    for number, (path, normal) in enumerate(zip(albedo, normals, strict=True), 1):
        called = f"{name} {number}" if number > 1 else name
        material = create_material(called, load_texture(path), normal)
        set_occlusion(material, dark[number - 1])
        materials.append(material)
    return materials


def load_data_maps(paths: Sequence[Path], count: int) -> list[bpy.types.Image | None]:
    """Load maps that are no colours, of ``count`` atlases; each None if there are none."""
    return [load_texture(path, "Non-Color") for path in paths] or [None] * count


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
        texture = nodes.new("ShaderNodeTexImage")
        texture.name, texture.location = _NORMAL_IMAGE, (-900, 500)
        normal = nodes.new("ShaderNodeNormalMap")
        normal.name, normal.location = _NORMAL, (-450, 500)
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
    texture = nodes.new("ShaderNodeTexImage")
    texture.name, texture.image, texture.location = _OCCLUSION_IMAGE, image, (-600, 700)
    red = nodes.new("ShaderNodeSeparateColor")
    red.name, red.location = _OCCLUSION_RED, (-250, 700)
    group = nodes.new("ShaderNodeGroup")
    group.name, group.node_tree, group.location = _OCCLUSION, _gltf_group(), (50, 700)
    links.new(texture.outputs["Color"], red.inputs["Color"])
    links.new(red.outputs["Red"], group.inputs["Occlusion"])
    nodes.active = active  # Workbench draws the active image
    return True


def _gltf_group() -> bpy.types.NodeTree:
    group: Any = bpy.data.node_groups.get(_GLTF_GROUP)
    if group is None:
        groups: Any = bpy.data.node_groups
        group = groups.new(_GLTF_GROUP, "ShaderNodeTree")
    if "Occlusion" not in group.interface.items_tree:
        group.interface.new_socket("Occlusion", in_out="INPUT", socket_type="NodeSocketFloat")
    found: bpy.types.NodeTree = group
    return found


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


def _nodes_of(material: Any) -> Any:
    return material.node_tree.nodes


def images_of(frame: bpy.types.Object | None) -> list[bpy.types.Image]:
    """Return the images in our materials on the meshes of a result, each once."""
    found = [
        node.image
        for child in (frame.children_recursive if frame is not None else ())
        if tags.kind_of(child) in tags.WITH_TEXTURE
        for slot in child.material_slots
        if shading_of(slot.material) is not None
        for node in _nodes_of(slot.material)
        if node.bl_idname == "ShaderNodeTexImage" and node.image is not None
    ]
    return list(dict.fromkeys(found))
