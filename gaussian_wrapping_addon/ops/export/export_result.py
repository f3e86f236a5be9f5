# SPDX-License-Identifier: GPL-3.0-or-later
"""Export a result folder as USD and FBX from an empty file, in background Blender."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...core.errors import UsageError
from ..common import tags
from ..results.blend_writer import start_empty
from ..results.import_operators import materials_of
from ..results.materials import set_shading
from ..results.scene_objects import import_result
from .export_objects import ObjectExport, export_objects


def export_result(
    result: Path,
    requests: list[ObjectExport],
    *,
    regions: tuple[str, ...] = (),
    levels: bool = False,
    shading: str = "auto",
) -> list[Path]:
    """Write meshes of a result; the open file is closed without saving.

    Parameters
    ----------
    result : Path
        The result folder.
    requests : list of ObjectExport
        One for each format.
    regions : tuple of str
        Names; empty for all.
    levels : bool
        Whether levels of detail are written too.
    shading : str
        ``"unlit"``, or lit.

    Raises
    ------
    UsageError
        Blender has a window, or there is no such region; what :func:`export_objects` raises.
    DatasetError, ParseError
        The folder contains no valid result.
    """
    start_empty("Exporting a result")
    imported = import_result(result, bpy.context.scene)
    known = {thing[tags.REGION] for thing in imported.meshes}
    missing = sorted(set(regions) - known)
    if missing:
        raise UsageError(
            f"{result} holds no mesh {missing[0]}.", f"Use {', '.join(sorted(known))}."
        )
    for material in materials_of(imported.frame):
        set_shading(material, "UNLIT" if shading == "unlit" else "LIT")
    kinds = ("mesh", "lod") if levels else ("mesh",)
    things = [
        thing
        for thing in imported.frame.children
        if tags.kind_of(thing) in kinds and (not regions or thing[tags.REGION] in regions)
    ]
    return [
        path for request in requests for path in export_objects(imported.frame, things, request)
    ]
