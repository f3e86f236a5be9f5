# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of meshes by Cycles: clay with its wires, or points; and strips of pictures with words.

``python -m benchmarks.paper.pictures REQUEST.npz OUT.png`` renders one request in a process of its
own, as Blender's state is global; :func:`render_mesh` writes the request and runs it.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.errors import WorkerError

from ..scenes.rendering import SENSOR_MM, blender_camera_values, require_bpy
from ..scenes.viewpoints import look_at
from ..speed_error.runs import ROOT

SAMPLES = 16
CLAY = (0.60, 0.55, 0.47)
WIRE = (0.03, 0.04, 0.06)
WIRE_PX = 0.9
"""Thickness of the wires in pixels of the picture."""
INSIDE = (0.75, 0.12, 0.10)
"""Colour of the back of faces: what is seen of it is a hole or a face turned over."""
SKY, SUN, SUN_DEGREES = 0.45, 3.0, 10.0
SUN_FROM = (-0.35, -0.75, 0.55)
"""Towards the sun; world axes of the scenes, whose things stand before -y."""

_BLENDER_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])


def eye_at(
    center: Sequence[float],
    target: Sequence[float],
    *,
    width: int,
    height: int,
    degrees: float,
    roll_degrees: float = 0.0,
) -> Camera:
    """Return a camera that looks at a point; world z is up, ``degrees`` is the width's angle."""
    pose = look_at(np.array(center, float), np.array(target, float), roll_degrees)
    focal = 0.5 * width / math.tan(math.radians(degrees) / 2)
    return Camera("eye", width, height, focal, focal, width / 2, height / 2, pose)


def render_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    *,
    wires: bool = True,
    colors: np.ndarray | None = None,
    smooth: bool = False,
    threads: int = 1,
) -> np.ndarray:
    """Return (h, w, 3) uint8: the mesh before white.

    Parameters
    ----------
    vertices : (v, 3)
        World frame, as the camera.
    wires : bool
        Draw every edge.
    colors : (v, 3), optional
        Linear colours in [0, 1] of the vertices, instead of clay.
    smooth : bool
        Shade smoothly instead of face by face.

    Raises
    ------
    WorkerError
        With the last words of Blender's process.
    """
    with tempfile.TemporaryDirectory(prefix="picture-") as folder:
        request, out = Path(folder) / "request.npz", Path(folder) / "out.png"
        np.savez(
            request,
            vertices=np.asarray(vertices, np.float32),
            faces=np.asarray(faces, np.int32),
            colors=np.zeros((0, 3)) if colors is None else np.asarray(colors, np.float32),
            facts=np.array(
                json.dumps(
                    {
                        "camera": camera.to_json(),
                        "wires": wires,
                        "smooth": smooth,
                        "threads": threads,
                    }
                )
            ),
        )
        command = [sys.executable, "-m", "benchmarks.paper.pictures", str(request), str(out)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode != 0 or not out.is_file():
            words = "\n".join((done.stdout + done.stderr).splitlines()[-12:])
            raise WorkerError(f"Rendering a picture failed: {words}", "Install bpy 5.0.1.")
        with Image.open(out) as image:
            return np.asarray(image.convert("RGB")).copy()


def dots(points: np.ndarray, radius: float, colors: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return vertices, faces and vertex colours of an octahedron at each of (n, 3) points."""
    corners = np.concatenate([np.eye(3), -np.eye(3)])  # (6, 3)
    sides = np.array(
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    )
    vertices = (points[:, None] + radius * corners).reshape(-1, 3)
    faces = (6 * np.arange(len(points))[:, None, None] + sides).reshape(-1, 3)
    return vertices, faces, np.repeat(colors, 6, axis=0)


def labelled(image: np.ndarray, text: str, *, size: int = 15) -> np.ndarray:
    """Return the picture with words in a band below it; a line break begins another line."""
    lines = text.split("\n")
    font = ImageFont.load_default(size)
    step = round(1.35 * size)
    band = Image.new("RGB", (image.shape[1], step * len(lines) + 8), (255, 255, 255))
    draw = ImageDraw.Draw(band)
    for row, line in enumerate(lines):
        draw.text((6, 4 + step * row), line, fill=(20, 20, 20), font=font)
    return np.concatenate([image, np.asarray(band)])


def grid(rows: Sequence[Sequence[np.ndarray]], gap: int = 6) -> np.ndarray:
    """Return pictures of equal size per row side by side, rows below one another."""

    def joined(images: Sequence[np.ndarray], axis: int) -> np.ndarray:
        shape = list(images[0].shape)
        shape[axis] = gap
        space = np.full(shape, 255, np.uint8)
        parts: list[np.ndarray] = []
        for image in images:
            parts += [space, image] if parts else [image]
        return np.concatenate(parts, axis)

    return joined([joined(list(row), 1) for row in rows], 0)


def save_picture(path: Path, image: np.ndarray, *, quality: int = 84) -> None:
    """Write a JPEG or PNG by the name."""
    options: dict[str, Any] = {"quality": quality} if path.suffix == ".jpg" else {"optimize": True}
    Image.fromarray(image).save(path, **options)


# -- inside of Blender's process ------------------------------------------------------------------


def _render(request: Path, out: Path) -> None:
    bpy = require_bpy()
    with np.load(request, allow_pickle=False) as arrays:
        vertices, faces, colors = arrays["vertices"], arrays["faces"], arrays["colors"]
        facts = json.loads(str(arrays["facts"]))
    camera = Camera.from_json(facts["camera"])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.seed = "CPU", SAMPLES, 0
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = False
    scene.cycles.max_bounces = 2
    scene.render.threads_mode, scene.render.threads = "FIXED", facts["threads"]
    scene.render.resolution_x, scene.render.resolution_y = camera.width, camera.height
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.view_settings.view_transform = "Standard"
    scene.render.dither_intensity = 0.0
    _world(bpy, scene)
    mesh = bpy.data.meshes.new("thing")
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.reshape(-1))
    mesh.loops.add(3 * len(faces))
    mesh.loops.foreach_set("vertex_index", faces.reshape(-1))
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(len(faces), facts["smooth"]))
    mesh.update(calc_edges=True)
    if len(colors):
        layer = mesh.color_attributes.new("shown", "FLOAT_COLOR", "POINT")
        filled = np.concatenate([colors, np.ones((len(colors), 1), np.float32)], 1)
        layer.data.foreach_set("color", filled.reshape(-1).astype(np.float32))
    mesh.materials.append(_material(bpy, wires=facts["wires"], colored=len(colors) > 0))
    scene.collection.objects.link(bpy.data.objects.new("thing", mesh))
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle = SUN, math.radians(SUN_DEGREES)
    item = bpy.data.objects.new("sun", sun)
    from mathutils import Matrix, Vector

    item.rotation_euler = Vector([-x for x in SUN_FROM]).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(item)
    eye = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    lens, shift_x, shift_y = blender_camera_values(camera)
    eye.data.sensor_fit, eye.data.sensor_width = "HORIZONTAL", SENSOR_MM
    eye.data.lens, eye.data.shift_x, eye.data.shift_y = lens, shift_x, shift_y
    eye.data.clip_start, eye.data.clip_end = 0.001, 100.0
    matrix = np.eye(4)
    matrix[:3, :3] = camera.rotation.T @ _BLENDER_FROM_CAMERA
    matrix[:3, 3] = camera.center
    eye.matrix_world = Matrix(matrix.tolist())
    scene.collection.objects.link(eye)
    scene.camera = eye
    scene.render.filepath = str(out)
    bpy.ops.render.render(write_still=True)


def _world(bpy: Any, scene: Any) -> None:
    """Light from everywhere, and white where the camera sees nothing."""
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    seen, light = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeBackground")
    seen.inputs["Color"].default_value = (1, 1, 1, 1)
    light.inputs["Strength"].default_value = SKY
    path, mix = nodes.new("ShaderNodeLightPath"), nodes.new("ShaderNodeMixShader")
    out = nodes.new("ShaderNodeOutputWorld")
    links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    links.new(light.outputs[0], mix.inputs[1])
    links.new(seen.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], out.inputs[0])
    scene.world = world


def _material(bpy: Any, *, wires: bool, colored: bool) -> Any:
    material = bpy.data.materials.new("clay")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    surface, out = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    if colored:
        source = nodes.new("ShaderNodeVertexColor")
        source.layer_name = "shown"
        color = source.outputs["Color"]
    else:
        side, both = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeMix")
        both.data_type = "RGBA"
        both.inputs[6].default_value = (*CLAY, 1)
        both.inputs[7].default_value = (*INSIDE, 1)
        links.new(side.outputs["Backfacing"], both.inputs[0])
        color = both.outputs[2]
    if wires:
        wire, mix = nodes.new("ShaderNodeWireframe"), nodes.new("ShaderNodeMix")
        wire.use_pixel_size = True
        wire.inputs["Size"].default_value = WIRE_PX
        mix.data_type = "RGBA"
        mix.inputs[7].default_value = (*WIRE, 1)
        links.new(wire.outputs[0], mix.inputs[0])
        links.new(color, mix.inputs[6])
        color = mix.outputs[2]
    links.new(color, surface.inputs["Color"])
    links.new(surface.outputs[0], out.inputs[0])
    return material


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    _render(Path(sys.argv[1]), Path(sys.argv[2]))
