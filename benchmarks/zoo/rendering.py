# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a zoo scene by Cycles: the set-up of :mod:`benchmarks.scenes.rendering`, other looks.

Blender's state is global: render one scene a process. bpy is imported inside the functions only.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.dataset.camera import Camera

from ..scenes.rendering import _add_light, _configure, _mesh_object, _place, require_bpy
from .content import Content
from .looks import make_look

SAMPLES = 4
"""Rays a pixel; the light of the sky is part of the looks and has no noise."""


def render_photos(
    content: Content, cameras: Sequence[Camera], paths: Sequence[Path], threads: int
) -> None:
    """Render one PNG a camera; all cameras have one size.

    Raises
    ------
    ResourceError
        bpy is missing.
    """
    bpy = require_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bounces = int(content.subject.reflects)
    scene = _configure(cameras[0].width, cameras[0].height, SAMPLES, bounces, threads)
    materials = {name: make_look(name, look) for name, look in content.looks.items()}
    for part in (*content.subject.parts, *content.around):
        item = _mesh_object(part, materials[part.material])
        # Looks shine with the sky's share of the light: scattered rays that find them are noise.
        item.visible_diffuse = False
    _add_light(content.light)
    eye = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(eye)
    scene.camera = eye
    for camera, path in zip(cameras, paths, strict=True):
        _place(eye, camera)
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
