# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write ``placement.json``: the transform of Blender's parent empty in float64."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import ParseError, UsageError
from ...files import read_json, write_json
from ..similarity import Similarity
from .placement import check_scale

FILE_NAME = "placement.json"
VERSION = 1
_ORTHONORMAL = 1e-9
"""Tolerance for products of a few float64 rotations."""


def write_placement(
    path: Path, blender_from_scene: Similarity, world_from_scene: Similarity
) -> None:
    """Write a placement together with its scene frame.

    Raises
    ------
    UsageError
        The file cannot be written.
    """
    values = {
        "version": VERSION,
        "blender_from_scene": blender_from_scene.to_json(),
        "world_from_scene": world_from_scene.to_json(),
    }
    try:
        write_json(path, values)
    except OSError as error:
        raise UsageError(
            f"{path} cannot be written: {error.strerror}.", "Check the folder's permissions."
        ) from None


def read_placement(path: Path, world_from_scene: Similarity) -> Similarity | None:
    """Read ``blender_from_scene``.

    Parameters
    ----------
    path : Path
    world_from_scene : Similarity
        Scene frame of the result that the placement applies to.

    Returns
    -------
    Similarity or None
        None if the file was written for another scene frame (the cameras were solved again), in
        which its lengths and directions differ.

    Raises
    ------
    ParseError
        The file holds no placement.
    """
    hint = "Delete the file; the scene is then placed as it was trained."
    try:
        values = read_json(path)
    except ParseError as error:
        raise ParseError(path, "whole file", "not JSON.", hint) from error
    try:
        if values["version"] != VERSION:
            raise ValueError(f"version {values['version']!r} is not {VERSION}")
        placement = Similarity.from_json(values["blender_from_scene"])
        known = Similarity.from_json(values["world_from_scene"])
        if not (np.isfinite(placement.matrix()).all() and np.isfinite(known.matrix()).all()):
            raise ValueError("a number is not finite")
        gram = placement.rotation @ placement.rotation.T
        if np.abs(gram - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(placement.rotation) < 0:
            raise ValueError("not a rotation")
        check_scale(placement)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, UsageError) as error:
        raise ParseError(path, "whole file", f"not a placement ({error}).", hint) from None
    return placement if known.to_json() == world_from_scene.to_json() else None
