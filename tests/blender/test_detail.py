# SPDX-License-Identifier: GPL-3.0-or-later
"""Normal maps as Blender reads them: tangents, pictures, materials; and levels of detail."""

from __future__ import annotations

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Vector

from gaussian_wrapping_addon.core.mesh.simplification import decimate
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.tangent_frame import tangent_frames
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas
from gaussian_wrapping_addon.core.texture.dense_detail import DenseSurface, bake_normal_map
from gaussian_wrapping_addon.core.texture.files import write_glb
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import unwrap
from gaussian_wrapping_addon.ops import addon
from gaussian_wrapping_addon.ops.mesh_data import build_mesh
from gaussian_wrapping_addon.ops.scene_objects import (
    create_material,
    import_result,
    load_texture,
    set_shading,
)
from tests.blender.synthetic_result import cube_mesh, png_bytes, write_region_result, write_result
from tests.core.texture.detail_scenes import bumpy_ball, degrees_between

SIZE_PX = 1024
GUTTER_PX = 4
SIDE_PX = 256
WANTED_DB = 30.0


def mesh_object(name: str, mesh: SurfaceMesh, uvs: np.ndarray) -> bpy.types.Object:
    thing = bpy.data.objects.new(name, build_mesh(name, mesh.vertices, mesh.faces, uvs))
    bpy.context.scene.collection.objects.link(thing)
    return thing


def test_tangents_are_blenders(tmp_path: Path) -> None:
    mesh = bumpy_ball(14, 0.06)
    uvs = unwrap(mesh, 512, 2, tmp_path, Progress()).corner_uvs
    uvs[::7, :, 0] = 1.0 - uvs[::7, :, 0]  # some faces mirrored, and cut off from the rest
    frames = tangent_frames(mesh.vertices, mesh.faces, uvs)
    assert {-1.0, 1.0} == set(frames.signs.tolist())
    data = mesh_object("ball", mesh, uvs).data
    data.calc_tangents(uvmap="UVMap")
    count = len(data.loops)
    tangents, normals, signs = (np.zeros(n * count, np.float32) for n in (3, 3, 1))
    data.loops.foreach_get("tangent", tangents)
    data.loops.foreach_get("normal", normals)
    data.loops.foreach_get("bitangent_sign", signs)
    assert (signs.reshape(-1, 3) == frames.signs[:, None]).all()
    assert degrees_between(normals.reshape(-1, 3, 3), frames.normals[mesh.faces]).max() < 0.1
    wrong = degrees_between(tangents.reshape(-1, 3, 3), frames.tangents)
    assert wrong.mean() < 0.05
    assert wrong.max() < 1.0


def lights_and_camera() -> None:
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location = (0.0, -3.4, 0.6)
    camera.rotation_euler = (-camera.location).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(camera)
    scene.camera = camera
    for energy, way in ((2.5, (1, -1, 1)), (1.0, (-1, -1, 0.3))):
        light = bpy.data.lights.new("sun", "SUN")
        light.energy, light.angle = energy, 0.0
        sun = bpy.data.objects.new("sun", light)
        sun.rotation_euler = Vector(way).to_track_quat("Z", "Y").to_euler()
        scene.collection.objects.link(sun)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.seed, scene.cycles.max_bounces = 16, 0, 0
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    scene.render.resolution_x = scene.render.resolution_y = SIDE_PX
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Standard"


def rendered(thing: bpy.types.Object, folder: Path) -> np.ndarray:
    """(h, w, 4) picture, 0 to 1, of one object alone."""
    for other in bpy.data.objects:
        if other.type == "MESH":
            other.hide_render = other != thing
    path = folder / f"{thing.name}.png"
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    return np.array(image.pixels).reshape(SIDE_PX, SIDE_PX, 4)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Over the pixels of either object."""
    covered = (one[..., 3] > 0) | (other[..., 3] > 0)
    colors = [image[..., :3] * image[..., 3:] for image in (one, other)]
    return float(-10.0 * np.log10(((colors[0] - colors[1])[covered] ** 2).mean()))


@pytest.mark.proof
@pytest.mark.slow
def test_5k_faces_with_a_normal_map_look_like_200k(tmp_path: Path) -> None:
    dense = bumpy_ball(129)
    assert len(dense.faces) == 199_692
    fewer = decimate(dense.vertices, dense.faces, 5000, Progress())
    light = SurfaceMesh(fewer.vertices, fewer.faces.astype(np.int32))
    assert len(light.faces) == 5000
    uvs = unwrap(light, SIZE_PX, GUTTER_PX, tmp_path, Progress()).corner_uvs
    raster = raster_atlas(uvs, SIZE_PX, 2)
    baked = bake_normal_map(light, uvs, raster, DenseSurface(dense), GUTTER_PX, Progress())
    assert baked.statistics["flat_share"] == 0.0
    (tmp_path / "normal.png").write_bytes(png_bytes(baked.image))
    (tmp_path / "albedo.png").write_bytes(png_bytes(np.full((8, 8, 3), 235, np.uint8)))
    albedo = load_texture(tmp_path / "albedo.png")
    normal_map = load_texture(tmp_path / "normal.png", "Non-Color")
    lights_and_camera()
    pictures = {}
    for name, mesh, own_uvs, image in (
        ("dense", dense, np.zeros((len(dense.faces), 3, 2), np.float32), None),
        ("mapped", light, uvs, normal_map),
        ("plain", light, uvs, None),
    ):
        thing = mesh_object(name, mesh, own_uvs)
        thing.data.materials.append(create_material(name, albedo, image))
        pictures[name] = rendered(thing, tmp_path)
    assert psnr(pictures["dense"], pictures["mapped"]) > WANTED_DB + 4.0
    assert psnr(pictures["dense"], pictures["plain"]) < WANTED_DB
    # The same through a GLB file, with the normals and tangents of Blender's reader.
    images = [(tmp_path / f"{kind}.png").read_bytes() for kind in ("albedo", "normal")]
    write_glb(
        tmp_path / "light.glb", light.vertices, light.faces, uvs, images[:1], np.zeros(3),
        normal_png=images[1:],
    )  # fmt: skip
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(tmp_path / "light.glb"))
    (read,) = [o for o in set(bpy.data.objects) - before if o.type == "MESH"]
    lit = next(n for n in read.data.materials[0].node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    ours = thing.data.materials[0].node_tree.nodes["Lit"]
    for name in ("Roughness", "Specular IOR Level"):
        lit.inputs[name].default_value = ours.inputs[name].default_value
    assert psnr(pictures["dense"], rendered(read, tmp_path)) > WANTED_DB + 4.0
    # Unlit the map is not looked at.
    set_shading(thing.data.materials[0], "UNLIT")
    plain = rendered(thing, tmp_path)
    mapped = bpy.data.objects["mapped"]
    set_shading(mapped.data.materials[0], "UNLIT")
    assert np.abs(plain - rendered(mapped, tmp_path)).max() < 1.5 / 255.0


def write_detail(region: Path, levels: int, *, with_normals: bool = True) -> None:
    """Add maps and levels to a region's folder."""
    flat = np.full((8, 8, 3), (128, 128, 255), np.uint8)
    vertices, faces, corner_uvs = cube_mesh(0.4)
    for number in range(levels + 1):
        folder = region / f"lod{number}" if number else region
        folder.mkdir(exist_ok=True)
        if number:
            np.savez(
                folder / "mesh.npz", vertices=vertices, faces=faces[: 12 - number],
                corner_uvs=corner_uvs[: 12 - number],
            )  # fmt: skip
            (folder / "albedo.png").write_bytes(png_bytes(np.zeros((8, 8, 3), np.uint8)))
        if with_normals:
            (folder / "normal.png").write_bytes(png_bytes(flat))


def normal_links(material: bpy.types.Material) -> list[str]:
    """Names of the nodes from the normal input backwards."""
    names, socket = [], material.node_tree.nodes["Lit"].inputs["Normal"]
    while socket.links:
        node = socket.links[0].from_node
        names.append(node.bl_idname)
        if "Color" not in node.inputs:
            break
        socket = node.inputs["Color"]
    return names


def test_imported_levels_and_normal_maps(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    write_detail(result / "auto", 2)
    imported = import_result(result, bpy.context.scene)
    (thing,) = imported.meshes
    folder = imported.collection.children["auto LODs"]
    assert [o.name for o in folder.objects] == ["auto LOD0", "auto LOD1", "auto LOD2"]
    assert thing == folder.objects[0]
    assert [o.hide_render for o in folder.objects] == [False, True, True]
    assert [o.hide_viewport for o in folder.objects] == [False, True, True]
    assert [len(o.data.polygons) for o in folder.objects] == [12, 11, 10]
    assert {o.parent for o in folder.objects} == {imported.frame}
    for level in folder.objects:
        material = level.data.materials[0]
        assert normal_links(material) == ["ShaderNodeNormalMap", "ShaderNodeTexImage"]
        image = material.node_tree.nodes["Normal Texture"].image
        assert image.colorspace_settings.name == "Non-Color"
        assert material.node_tree.nodes.active.image.name.startswith("albedo")
    # Again: nothing is doubled.
    again = import_result(result, bpy.context.scene)
    assert [o.name for o in folder.objects] == ["auto LOD0", "auto LOD1", "auto LOD2"]
    assert again.meshes == imported.meshes


def test_a_mesh_made_anew_replaces_levels_and_loses_its_normal_map(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    write_detail(result / "auto", 2)
    (thing,) = import_result(result, bpy.context.scene).meshes
    for path in sorted((result / "auto").rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    write_region_result(result / "auto", half=0.7)
    write_detail(result / "auto", 1, with_normals=False)
    imported = import_result(result, bpy.context.scene)
    assert imported.meshes == (thing,)
    folder = imported.collection.children["auto LODs"]
    assert [o.name for o in folder.objects] == ["auto LOD0", "auto LOD1"]
    assert normal_links(thing.data.materials[0]) == []
    levels = [o for o in bpy.data.objects if addon.kind_of(o) == "lod"]
    assert [json.dumps(o[addon.LEVEL]) for o in levels] == ["1"]
    assert len(bpy.data.meshes) == 2
