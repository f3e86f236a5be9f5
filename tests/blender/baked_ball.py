# SPDX-License-Identifier: GPL-3.0-or-later
"""A finished job of a coloured ball, imported and placed anew, whose photos can be baked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.ops import addon
from gaussian_wrapping_addon.ops.placement import place
from tests.blender.synthetic_result import rotation_about
from tests.core.training.small_scene import surface_color

BLENDER_FROM_SCENE = Similarity(1.7, rotation_about((1, 1, 2), 0.9), np.array([3.0, -2.0, 5.0]))
"""Where the result stands in Blender: scaled, turned and moved."""


def import_ball(folder: JobFolder) -> bpy.types.Object:
    """Import the result and place it; return its frame."""
    assert bpy.ops.gwrap.import_result(directory=str(folder.result)) == {"FINISHED"}
    frame = next(addon.objects_of_kind(bpy.context.scene, "frame"))
    place(frame, BLENDER_FROM_SCENE)
    bpy.context.view_layer.update()
    return frame


def add_ball(name: str = "Foreign", *, uvs: bool = False) -> bpy.types.Object:
    """Add a ball of quads over the photographed one, with a scale and rotation of its own."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=32, ring_count=20, calc_uvs=uvs)
    thing: Any = bpy.context.object
    thing.name = name
    thing.scale = (BLENDER_FROM_SCENE.scale,) * 3
    thing.rotation_euler = (0.4, -0.2, 1.0)
    thing.location = BLENDER_FROM_SCENE.translation.tolist()
    bpy.context.view_layer.update()
    return thing


def psnr_of_textures(thing: bpy.types.Object) -> float:
    """Return the PSNR of the textures at the middles of faces against the ball's colours."""
    evaluated: Any = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    mesh.calc_loop_triangles()
    layer = next(layer for layer in mesh.uv_layers if layer.active_render)
    matrix = np.array(thing.matrix_world)
    wanted, found = [], []
    pixels = pixels_of(thing)
    for triangle in mesh.loop_triangles:
        u, v = np.mean([layer.uv[k].vector for k in triangle.loops], axis=0)
        point = np.mean([mesh.vertices[k].co for k in triangle.vertices], axis=0)
        point = matrix[:3, :3] @ point + matrix[:3, 3]
        scene = BLENDER_FROM_SCENE.inverse().points(point[None])[0]
        wanted.append(surface_color(scene[None] / np.linalg.norm(scene))[0])
        grid = pixels[1001 + int(u) + 10 * int(v)]
        side = len(grid)
        found.append(grid[int((v % 1.0) * side), int((u % 1.0) * side)])
    evaluated.to_mesh_clear()
    squared = (np.array(wanted) - np.array(found)) ** 2
    return float(-10.0 * np.log10(squared.mean()))


def pixels_of(thing: bpy.types.Object) -> dict[int, np.ndarray]:
    """Return the (side, side, 3) pixels, the first row below, of each tile of the texture."""
    from PIL import Image

    image = image_of(thing)
    path = Path(bpy.path.abspath(image.filepath))
    numbers = [tile.number for tile in image.tiles] if image.source == "TILED" else [1001]
    files = {n: Path(str(path).replace("<UDIM>", str(n))) for n in numbers}
    return {n: np.asarray(Image.open(file), float)[::-1] / 255.0 for n, file in files.items()}


def image_of(thing: bpy.types.Object) -> Any:
    """Return the image that a mesh's only material shows."""
    (slot,) = thing.material_slots
    return slot.material.node_tree.nodes["Photo Texture"].image
