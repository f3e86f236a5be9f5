# SPDX-License-Identifier: GPL-3.0-or-later
"""Write a result as .blend and USD, in a Blender without a window."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from ...core.errors import ResourceError, UsageError
from ..cameras.camera_objects import look_through
from ..common import tags
from .materials import fold_specular
from .scene_objects import import_result


def write_blend(result_folder: Path, path: Path) -> None:
    """Write a .blend file of a result; images stay beside it, with relative paths.

    The file that is open in this Blender is closed without saving, so this is for
    background Blender only.

    Raises
    ------
    UsageError
        Blender has a window, or the file cannot be written.
    DatasetError, ParseError
        The folder contains no valid result.
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
    imported.frame[tags.RESULT] = _relative(result_folder.resolve(), path.parent)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(path), relative_remap=False, check_existing=False)
    except RuntimeError as error:
        raise ResourceError(
            f"{path} cannot be written: {error}.", "Choose another folder."
        ) from None


def export_usd(result_folder: Path) -> list[Path]:
    """Write ``<region>/mesh.usdc`` for each region of a result, textures by relative path.

    Closes the open file, as :func:`write_blend` does.

    Returns
    -------
    paths : list of Path
        The files written.
    """
    start_empty("Writing USD")
    imported = import_result(result_folder, bpy.context.scene)
    options = {
        "selected_objects_only": True,
        "export_materials": True,
        "relative_paths": True,
        "export_textures": False,  # before Blender 4.4
        "export_textures_mode": "KEEP",  # since
    }
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
        path = result_folder.resolve() / mesh[tags.REGION] / "mesh.usdc"
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
