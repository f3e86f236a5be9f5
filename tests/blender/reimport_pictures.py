# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m tests.blender.reimport_pictures FORMAT SHADING PACK ATLASES FOLDER``, a process.

Exports a placed, textured ball with a normal map, reads the file with Blender's importer as it is
by default, and renders both. Prints what was found as the last line, JSON.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("BLENDER_USER_RESOURCES", tempfile.mkdtemp(prefix="gwrap-profile-"))

import bpy
import numpy as np

from gaussian_wrapping_addon.core.jobs.commands.export_files import ExportRequest, export_files
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.placement import FILE_NAME, write_placement
from gaussian_wrapping_addon.core.texture.file_checks import atlas_file
from gaussian_wrapping_addon.ops.export import ObjectExport, export_objects
from gaussian_wrapping_addon.ops.scene_objects import import_result, set_shading
from tests.blender.synthetic_result import (
    WORLD_FROM_SCENE,
    png_bytes,
    rotation_about,
    write_result,
)
from tests.blender.test_detail import lights_and_camera, psnr, rendered
from tests.core.texture.detail_scenes import bumpy_ball, flat_uvs

PLACEMENT = Similarity(0.9, rotation_about((1, 0.2, 0.5), 1.1), np.array([0.1, 0.2, -0.05]))
IMPORTERS = {
    "glb": ("import_scene", "gltf"), "obj": ("wm", "obj_import"), "usd": ("wm", "usd_import"),
    "fbx": ("import_scene", "fbx"), "ply": ("wm", "ply_import"),
}  # fmt: skip


def textures() -> tuple[np.ndarray, np.ndarray]:
    """Colours that tell mirrored from right, and a map of waves: (128, 128, 3) uint8 each."""
    y, x = np.mgrid[0:128, 0:128] / 128.0
    checker = ((x * 12).astype(int) + (y * 12).astype(int)) % 2
    colors = np.stack([x, 0.8 - 0.6 * y, 0.25 + 0.5 * checker], axis=2)
    slope = 0.5 * np.stack([np.sin(60 * x), np.cos(45 * y)], axis=2)
    normals = np.concatenate([slope, np.ones((128, 128, 1))], axis=2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return (255 * colors).astype(np.uint8), np.rint(127.5 * (normals + 1)).astype(np.uint8)


def write_ball(job: Path, atlases: int) -> Path:
    """A result with one region, a bumpy ball; every other face in each of two atlases."""
    result = write_result(job)
    ball = bumpy_ball(24)
    colors, normals = textures()
    # Bands around the ball: a picture tells which atlas is where.
    owner = (4.0 * ball.vertices[ball.faces].mean(axis=1)[:, 2]).astype(int) % atlases
    several = {"face_atlas": owner.astype(np.uint8)} if atlases > 1 else {}
    np.savez(
        result / "auto" / "mesh.npz", vertices=ball.vertices, faces=ball.faces,
        corner_uvs=flat_uvs(ball), **several,
    )  # fmt: skip
    for number in range(atlases):
        for name, pixels in (("albedo", np.roll(colors, number, 2)), ("normal", normals)):
            path = result / "auto" / atlas_file(name, number)
            path.write_bytes(png_bytes(np.ascontiguousarray(pixels)))
    return result


def main(format: str, shading: str, pack: bool, atlases: int, folder: Path) -> dict:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    result = write_ball(folder / "job", atlases)
    write_placement(result / FILE_NAME, PLACEMENT, WORLD_FROM_SCENE)
    imported = import_result(result, bpy.context.scene)
    (thing,) = imported.meshes
    for slot in thing.material_slots:
        set_shading(slot.material, shading)
    if format.startswith("own-"):
        format = format.removeprefix("own-")
        own = ExportRequest(result, folder / "out", (format,), placed=True, shading=shading.lower())
        (path,) = export_files(own)
    else:
        request = ObjectExport(format, folder / "out", placed=True, pack=pack)
        (path,) = export_objects(imported.frame, [thing], request)
    for image in (result / "auto").glob("*.png"):
        image.rename(image.with_suffix(".away"))  # the file must not look there
    before, images = set(bpy.data.objects), set(bpy.data.images)
    module, name = IMPORTERS[format]
    getattr(getattr(bpy.ops, module), name)(filepath=str(path))
    (read,) = [o for o in set(bpy.data.objects) - before if o.type == "MESH"]
    found = [i for i in set(bpy.data.images) - images if i.source == "FILE"]
    sizes = [list(image.size) for image in found]
    for node in [n for slot in read.material_slots for n in slot.material.node_tree.nodes]:
        # Blender's reader of OBJ takes normal maps for colours: a person has to say it once.
        if format == "obj" and node.bl_idname == "ShaderNodeNormalMap":
            image = node.inputs["Color"].links[0].from_node.image
            image.colorspace_settings.name = "Non-Color"
    read.name = "read"
    second = rendered_file(read, folder)
    for image in (result / "auto").glob("*.away"):
        image.rename(image.with_suffix(".png"))
    first = rendered_file(thing, folder)
    mirrored = second[:, ::-1]
    return {
        "psnr": psnr(first, second),
        "psnr_mirrored": psnr(first, mirrored),
        "covered": float((first[..., 3] > 0.5).mean()),
        "contrast": float(first[..., :3][first[..., 3] > 0.5].std()),
        "images": sizes,
        "files": sorted(p.name for p in (folder / "out").iterdir()),
        "materials": [slot.material.name for slot in read.material_slots],
        "unlit_pattern": any(
            node.bl_idname == "ShaderNodeLightPath"
            for slot in read.material_slots
            for node in slot.material.node_tree.nodes
        ),
    }


def rendered_file(thing: bpy.types.Object, folder: Path) -> np.ndarray:
    """Picture of one object, by Cycles under two suns."""
    if bpy.context.scene.camera is None:
        lights_and_camera()
        bpy.context.scene.render.threads = 1
    return rendered(thing, folder)


if __name__ == "__main__":
    kind, shade, packed, number_of_atlases, place_of_files = sys.argv[1:]
    values = main(kind, shade, packed == "pack", int(number_of_atlases), Path(place_of_files))
    sys.stdout.write("\n" + json.dumps(values) + "\n")
