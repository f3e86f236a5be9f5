# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of parts by Cycles, through cameras of the COLMAP convention.

Blender's state is global: render one scene a process. bpy is imported inside the functions only.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.errors import ResourceError

from .baking import bake_walls
from .geometry import SHARP_DEGREES, Part
from .materials import make_mask_material, make_material, make_picture_material

SENSOR_MM = 36.0
FILTER_WIDTH_PX = 1.2
"""Width of the pixel filter: a little softer than a box, as lenses are."""

SUN_DEGREES = 14.0
"""Size of the sun: it makes soft shadows."""

_BLENDER_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
"""Blender's cameras look along -z with y up, ours along +z with y down."""


@dataclass(frozen=True)
class Light:
    """A soft sun; the sky's even light is part of the materials (``nodes.py``)."""

    sun: float
    """Irradiance; a white matte surface that faces it returns this / pi."""
    direction: tuple[float, float, float] = (-0.4, 0.5, -0.9)
    """From the sun to the scene."""


def require_bpy() -> Any:
    """Import bpy.

    Raises
    ------
    ResourceError
        It is not installed.
    """
    try:
        import bpy
    except ModuleNotFoundError:
        raise ResourceError(
            "The ground-truth scenes are rendered by Blender's Python module, which is missing.",
            "Install it into this Python: pip install bpy==5.0.1 (Python 3.11).",
        ) from None
    return bpy


def _mesh_object(part: Part, material: Any) -> Any:
    import bpy

    mesh = bpy.data.meshes.new(part.name)
    mesh.from_pydata(part.vertices.tolist(), [], part.faces.tolist())
    if part.corner_uvs is not None:
        layer = mesh.uv_layers.new(name="uv")
        layer.data.foreach_set("uv", part.corner_uvs.reshape(-1).astype(np.float32))
    if part.smooth:
        mesh.shade_smooth()
        mesh.set_sharp_from_angle(angle=math.radians(SHARP_DEGREES))
    mesh.materials.append(material)
    item = bpy.data.objects.new(part.name, mesh)
    bpy.context.scene.collection.objects.link(item)
    if part.surrounding:
        item.visible_shadow = False
        item.visible_diffuse = False  # so that scattered rays do not find its lamps by chance
    return item


def _add_light(light: Light) -> None:
    import bpy
    from mathutils import Vector

    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle = light.sun, math.radians(SUN_DEGREES)
    item = bpy.data.objects.new("sun", sun)
    item.rotation_euler = Vector(light.direction).to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(item)


def _configure(width: int, height: int, samples: int, glossy_bounces: int, threads: int) -> Any:
    import bpy

    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.seed = 0
    scene.cycles.use_denoising = False
    scene.cycles.max_bounces = glossy_bounces
    scene.cycles.diffuse_bounces = 0
    scene.cycles.glossy_bounces = glossy_bounces
    scene.cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    scene.cycles.filter_width = FILTER_WIDTH_PX
    scene.render.threads_mode = "FIXED"
    scene.render.threads = threads or os.cpu_count() or 1
    scene.render.use_persistent_data = True
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1.0
    scene.render.dither_intensity = 0.0
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.color_depth = "8"
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    return scene


def blender_camera_values(camera: Camera) -> tuple[float, float, float]:
    """Return Blender's focal length (mm), shift_x and shift_y of a camera with fx = fy.

    Blender measures shifts in shares of the fitted (horizontal) size, from the image's middle;
    y points up there.
    """
    lens = camera.fx * SENSOR_MM / camera.width
    shift_x = (camera.width / 2 - camera.cx) / camera.width
    shift_y = (camera.cy - camera.height / 2) / camera.width
    return lens, shift_x, shift_y


def _place(item: Any, camera: Camera) -> None:
    from mathutils import Matrix

    lens, shift_x, shift_y = blender_camera_values(camera)
    item.data.sensor_fit = "HORIZONTAL"
    item.data.sensor_width = SENSOR_MM
    item.data.lens, item.data.shift_x, item.data.shift_y = lens, shift_x, shift_y
    item.data.clip_start, item.data.clip_end = 0.01, 1000.0
    matrix = np.eye(4)
    matrix[:3, :3] = camera.rotation.T @ _BLENDER_FROM_CAMERA
    matrix[:3, 3] = camera.center
    item.matrix_world = Matrix(matrix.tolist())


def render_photos(
    parts: Sequence[Part],
    cameras: Sequence[Camera],
    paths: Sequence[Path],
    light: Light,
    *,
    samples: int = 5,
    wall_density: float = 140.0,
    wall_shadows: bool = False,
    glossy_bounces: int = 0,
    threads: int = 0,
    mask_of: Callable[[Part], bool] | None = None,
    done: Callable[[int], None] | None = None,
) -> None:
    """Render one PNG a camera.

    Parameters
    ----------
    samples : int
        Rays a pixel; the seed is fixed.
    wall_density : float
        Pixels per unit of length of the pictures that walls are hung with.
    wall_shadows : bool
        Whether the sun reaches the walls and floor; else they are lit evenly, which is quicker.
    glossy_bounces : int
        0 for matte scenes, 1 where things reflect their room.
    mask_of : function or None
        Instead of photos, write masks that are white where a part of these is seen.
    done : function or None
        Called with the number of finished photos.

    Raises
    ------
    ResourceError
        bpy is missing.
    """
    bpy = require_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = _configure(cameras[0].width, cameras[0].height, samples, glossy_bounces, threads)
    if mask_of is not None:
        masks = {seen: make_mask_material(seen) for seen in (False, True)}
        scene.view_settings.view_transform = "Raw"
    materials: dict[str, Any] = {}
    if mask_of is None:
        folder = Path(tempfile.mkdtemp(prefix="walls-"))
        parts, pictures = bake_walls(parts, folder, wall_density, scene)
        materials = {
            name: make_picture_material(path, shadows=wall_shadows)
            for name, path in pictures.items()
        }
        _configure(cameras[0].width, cameras[0].height, samples, glossy_bounces, threads)
    for part in parts:
        if mask_of is not None:
            material = masks[bool(mask_of(part))]
        else:
            if part.material not in materials:
                materials[part.material] = make_material(part.material)
            material = materials[part.material]
        _mesh_object(part, material)
    _add_light(light)
    eye = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(eye)
    scene.camera = eye
    for index, (camera, path) in enumerate(zip(cameras, paths, strict=True)):
        _place(eye, camera)
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        if done is not None:
            done(index + 1)
    if mask_of is None:
        shutil.rmtree(folder)


def union_of(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (v, 3) and faces (f, 3) of the exact union of closed solids.

    Raises
    ------
    ResourceError
        bpy is missing.
    """
    bpy = require_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    material = bpy.data.materials.new("any")
    items = [_mesh_object(part, material) for part in parts]
    base = items[0]
    for item in items[1:]:
        modifier = base.modifiers.new(item.name, "BOOLEAN")
        modifier.operation, modifier.solver, modifier.object = "UNION", "MANIFOLD", item
    graph = bpy.context.evaluated_depsgraph_get()
    mesh = base.evaluated_get(graph).to_mesh()
    mesh.calc_loop_triangles()
    vertices = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", vertices)
    faces = np.empty(len(mesh.loop_triangles) * 3, np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces)
    return vertices.reshape(-1, 3).astype(np.float64), faces.reshape(-1, 3)
