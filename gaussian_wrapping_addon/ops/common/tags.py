# SPDX-License-Identifier: GPL-3.0-or-later
"""Custom properties that tag the add-on's objects; they survive undo, renaming and saving."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import bpy

from ...core.dataset.similarity import Similarity
from ...core.errors import UsageError

KIND = "gwrap_kind"
"""``"frame"`` (the parent empty), ``"mesh"``, ``"lod"``, ``"camera"``, ``"region"``,
``"point"`` or ``"baked"``."""
WITH_TEXTURE = ("mesh", "lod", "baked")
"""Kinds of meshes with our material: of regions, coarser levels, lighter meshes of a bake."""
RESULT = "gwrap_result"
"""On the frame: the result folder; ``//`` means beside the .blend file."""
FINGERPRINT = "gwrap_fingerprint"
WORLD_FROM_SCENE = "gwrap_world_from_scene"
"""On the frame: the similarity as JSON text, in float64, which object matrices are not."""
PLACEMENT = "gwrap_blender_from_scene"
"""On the frame: the similarity of its matrix as JSON text, in float64, once it has been placed."""
FIGURES = "gwrap_figures"
"""On the frame: figures of the report as JSON text (``report_data.py``)."""
REGION = "gwrap_region"
"""On meshes and regions: the name of the region in the result folder."""
LEVEL = "gwrap_level"
"""On levels of detail: 1, 2, ..."""
STAMP = "gwrap_stamp"
"""On meshes and levels of detail: changes when the mesh file changes."""
BAKE = "gwrap_bake"
"""On any mesh object that photos are baked onto: the folder of the bake below ``baked``."""
BAKE_NOTE = "gwrap_bake_note"
"""On the same: what the last bake says of itself, for the panel."""
PHOTO = "gwrap_photo"
RESOLUTION = "gwrap_resolution_px"
PIXEL_ASPECT = "gwrap_pixel_aspect"
DISPLAY_SCALE = "gwrap_display_scale"
"""On photo cameras: the scale of the scene that clipping and frustum size are for."""


def kind_of(thing: bpy.types.Object | None) -> str:
    """Return the tag of an object, or ``""``."""
    value = thing.get(KIND, "") if thing is not None else ""
    return value if isinstance(value, str) else ""


def objects_of_kind(scene: bpy.types.Scene, kind: str) -> Iterator[bpy.types.Object]:
    """Yield the objects of a scene that have a tag."""
    return (thing for thing in scene.objects if kind_of(thing) == kind)


def scene_of_uid(uid: int) -> bpy.types.Scene | None:
    """Return the scene of a session uid in the open file."""
    return next((s for s in bpy.data.scenes if s.session_uid == uid), None)


def frame_of(thing: bpy.types.Object | None) -> bpy.types.Object | None:
    """Return the parent empty of a result's object (or the object itself), or None."""
    while thing is not None:
        if kind_of(thing) == "frame":
            return thing
        thing = thing.parent
    return None


def current_frame(
    scene: bpy.types.Scene, active: bpy.types.Object | None
) -> bpy.types.Object | None:
    """Return the frame of the active object, or else the scene's newest one, or None."""
    frame = frame_of(active)
    if frame is not None:
        return frame
    frames = list(objects_of_kind(scene, "frame"))
    return frames[-1] if frames else None


def result_folder(frame: bpy.types.Object) -> Path:
    """Return the result folder that a frame names.

    Raises
    ------
    UsageError
        The frame has none.
    """
    text = frame.get(RESULT, "")
    if not isinstance(text, str) or not text:
        raise UsageError(f"{frame.name} has no result folder.", "Import the result again.")
    return Path(bpy.path.abspath(text))


def world_from_scene(frame: bpy.types.Object) -> Similarity:
    """Return the similarity from the scene frame to the world of the input.

    Raises
    ------
    UsageError
        The custom property is missing or was edited.
    """
    try:
        return Similarity.from_json(json.loads(frame[WORLD_FROM_SCENE]))
    except (KeyError, TypeError, ValueError, RecursionError):
        raise UsageError(
            f"{frame.name} has lost its world coordinates.", "Import the result again."
        ) from None


def figures_of(frame: bpy.types.Object | None) -> str:
    """Return the figures of the report as JSON text; ``""`` where there are none."""
    value = frame.get(FIGURES, "") if frame is not None else ""
    return value if isinstance(value, str) else ""
