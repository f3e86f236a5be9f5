# SPDX-License-Identifier: GPL-3.0-or-later
"""The transform of a result's parent empty: read, set, saved in double beside the result."""

from __future__ import annotations

import contextlib
import json
import logging
from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent
from mathutils import Matrix

from ...core.dataset.frames.placement import check_scale, similarity_of_matrix
from ...core.dataset.frames.placement_file import FILE_NAME, write_placement
from ...core.dataset.similarity import Similarity
from ...core.dataset.units.real_units import blender_start
from ...core.errors import ParseError, UsageError
from ...core.files import read_json, real_path
from ..cameras.camera_objects import cameras_under, scale_display
from ..common import known_jobs, tags
from ..regions.region_objects import matrix_of

_logger = logging.getLogger(__name__)

MATRIX_TOLERANCE = 1e-5
"""Share by which an object's matrix (single precision, by way of angles) may differ from the
placement that was set."""

# What this session has written, by path, and the empty that it is of: undo takes it back there as
# well. Of two empties of one result the one that wrote last decides.
_written: dict[Path, tuple[str, str]] = {}


def placement_of(frame: bpy.types.Object) -> Similarity:
    """Return ``blender_from_scene``: in double if it was set so, else Blender's matrix.

    Raises
    ------
    UsageError
        The empty is scaled differently along its axes, mirrored or has no size.
    """
    matrix = matrix_of(frame)
    stored = _stored(frame)
    if stored is not None and _agrees(matrix, stored):
        return stored
    return similarity_of_matrix(matrix, frame.name)


def scale_of(frame: bpy.types.Object) -> float:
    """Return the scale of a frame of any transform; 1 if it is degenerate."""
    volume = abs(float(np.linalg.det(matrix_of(frame)[:3, :3])))
    return float(np.cbrt(volume)) if np.isfinite(volume) and volume > 0.0 else 1.0


def place(frame: bpy.types.Object, placement: Similarity) -> str:
    """Set the transform of a frame to ``placement``, and save it beside the result.

    Nothing but the empty is moved; clipping and frustum size of the photo cameras follow its
    scale, since Blender does not let them.

    Returns
    -------
    note : str
        Why the placement could not be saved beside the result; ``""`` if it was.

    Raises
    ------
    UsageError
        The scale is out of range, or something else holds the empty in place.
    """
    check_scale(placement)
    before = frame.matrix_basis.copy()
    _set_matrix(frame, placement)
    if not _agrees(matrix_of(frame), placement):
        frame.matrix_basis = before
        bpy.context.view_layer.update()
        raise UsageError(
            f"{frame.name} is held in place by a constraint, a driver or its parent.",
            "Remove it, or use it on a parent of a result that is free.",
        )
    for camera in cameras_under(frame):
        scale_display(camera, placement.scale)
    frame[tags.PLACEMENT] = json.dumps(placement.to_json())
    return _keep(frame, placement)


def first_placement(frame: bpy.types.Object) -> Similarity:
    """Return where the frame's result lies before it is placed: in metres where it has them."""
    with contextlib.suppress(OSError, UsageError, ParseError, AttributeError):
        folder = real_path(tags.result_folder(frame))
        if known_jobs.is_trusted(folder.parent):
            record = read_json(folder / "scene.json").get("georeference")
            return blender_start(record, tags.world_from_scene(frame)) or Similarity()
    return Similarity()


def restore(frame: bpy.types.Object, placement: Similarity) -> None:
    """Apply the placement saved beside its result to a new frame."""
    _set_matrix(frame, placement)
    frame[tags.PLACEMENT] = json.dumps(placement.to_json())


def _set_matrix(frame: bpy.types.Object, placement: Similarity) -> None:
    bpy.context.view_layer.update()  # where it has a parent, Blender needs that one's matrix
    frame.matrix_world = Matrix(placement.matrix().tolist())
    bpy.context.view_layer.update()


def _stored(frame: bpy.types.Object) -> Similarity | None:
    with contextlib.suppress(KeyError, TypeError, ValueError, RecursionError):
        stored = Similarity.from_json(json.loads(frame[tags.PLACEMENT]))
        if np.isfinite(stored.matrix()).all():
            return stored
    return None


def _agrees(matrix: np.ndarray, placement: Similarity) -> bool:
    wanted = placement.matrix()
    linear = np.abs(matrix[:3, :3] - wanted[:3, :3]).max()
    moved = np.abs(matrix[:3, 3] - wanted[:3, 3]).max()
    reach = placement.scale + float(np.abs(wanted[:3, 3]).max())
    return bool(linear <= MATRIX_TOLERANCE * placement.scale and moved <= MATRIX_TOLERANCE * reach)


def _keep(frame: bpy.types.Object, placement: Similarity) -> str:
    """Write the placement beside the result; the folder is one that a .blend names."""
    lost = "The placement is saved in this .blend file only"
    try:
        folder = real_path(tags.result_folder(frame))
        world_from_scene = tags.world_from_scene(frame)
    except UsageError as error:
        return f"{lost}: {error}"
    if not known_jobs.is_trusted(folder.parent):
        return f"{lost}: import the result from {folder} to keep it there too."
    if not (folder / "scene.json").is_file():
        return f"{lost}: {folder} does not exist."
    path = folder / FILE_NAME
    try:
        write_placement(path, placement, world_from_scene)
    except UsageError as error:
        return f"{lost}: {error}"
    _written[path] = frame.name, frame[tags.PLACEMENT]
    return ""


@persistent
def after_load(_arguments: object = None, _unused: object = None) -> None:
    """``load_post``: undo steps of the file before are gone."""
    _written.clear()


@persistent
def after_undo(_scene: object = None, _unused: object = None) -> None:
    """``undo_post``, ``redo_post``: what this session wrote beside a result follows."""
    for frame in bpy.data.objects:
        if tags.kind_of(frame) != "frame" or frame.library is not None or not _written:
            continue
        try:
            path = real_path(tags.result_folder(frame)) / FILE_NAME
            world_from_scene = tags.world_from_scene(frame)
        except UsageError:
            continue
        name, text = _written.get(path, ("", ""))
        if frame.name != name or text == frame.get(tags.PLACEMENT, ""):
            continue
        # Before its first placement, a scene lies as it was trained.
        try:
            write_placement(path, _stored(frame) or Similarity(), world_from_scene)
            _written[path] = name, frame.get(tags.PLACEMENT, "")
        except UsageError:
            _logger.exception("the placement beside the result is not the one in Blender")
