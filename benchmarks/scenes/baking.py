# SPDX-License-Identifier: GPL-3.0-or-later
"""Patterns of the room's flat surfaces as images: looking up is cheaper than making noise.

Each wall is photographed once, straight from the front and without light, then hung with its own
picture. bpy is imported inside the functions only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .geometry import Part
from .materials import make_material

SAMPLES = 3
_NEVER = ("lamp_panel",)
"""Materials that are even already."""


def group_name(part: Part) -> str:
    """Return the wall that a sheet belongs to: the first word of its name."""
    return part.name.split(" ")[0]


def bake_walls(
    parts: Sequence[Part], folder: Path, pixels_per_unit: float, scene: Any
) -> tuple[list[Part], dict[str, Path]]:
    """Photograph the walls' patterns.

    Parameters
    ----------
    parts : sequence of Part
        Those that are ``surrounding`` and flat are baked, wall by wall.
    pixels_per_unit : float
    scene : Blender scene
        Configured for Cycles; used and left empty.

    Returns
    -------
    parts : list of Part
        The same geometry; baked ones have texture coordinates and the wall's name as material.
    images : dict
        Wall's name -> PNG.
    """
    walls: dict[str, list[Part]] = {}
    for part in parts:
        if part.surrounding and part.material not in _NEVER:
            walls.setdefault(group_name(part), []).append(part)
    images = {name: folder / f"{name}.png" for name in walls}
    result = [part for part in parts if group_name(part) not in walls or not part.surrounding]
    scene.cycles.samples = SAMPLES
    for name, sheets in walls.items():
        result += _bake(name, sheets, images[name], pixels_per_unit, scene)
    return result, images


def _bake(name: str, sheets: list[Part], path: Path, density: float, scene: Any) -> list[Part]:
    import bpy
    from mathutils import Matrix

    a, b, _, d = sheets[0].vertices  # (3,) corner, its right, opposite, its top
    right, up = (b - a) / np.linalg.norm(b - a), (d - a) / np.linalg.norm(d - a)
    everything = np.concatenate([part.vertices for part in sheets]) - a
    flat = np.stack([everything @ right, everything @ up], 1)  # (v, 2)
    low, high = flat.min(0), flat.max(0)
    size = high - low
    scene.render.resolution_x, scene.render.resolution_y = np.ceil(size * density).astype(int)
    items = []
    for part in sheets:
        mesh = bpy.data.meshes.new(part.name)
        mesh.from_pydata(part.vertices.tolist(), [], part.faces.tolist())
        mesh.materials.append(make_material(part.material, unlit=True))
        items.append(bpy.data.objects.new(part.name, mesh))
    lens = bpy.data.cameras.new("front")
    lens.type, lens.sensor_fit, lens.ortho_scale = "ORTHO", "HORIZONTAL", float(size[0])
    eye = bpy.data.objects.new("front", lens)
    matrix = np.eye(4)
    normal = np.cross(right, up)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = right, up, normal
    middle = (low + high) / 2
    matrix[:3, 3] = a + middle[0] * right + middle[1] * up + normal
    eye.matrix_world = Matrix(matrix.tolist())
    for item in [*items, eye]:
        scene.collection.objects.link(item)
    scene.camera = eye
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    for item in [*items, eye]:
        bpy.data.objects.remove(item)
    hung = []
    for part in sheets:
        local = part.vertices - a
        share = (np.stack([local @ right, local @ up], 1) - low) / size  # (v, 2)
        hung.append(replace(part, corner_uvs=share[part.faces], material=name))
    return hung
