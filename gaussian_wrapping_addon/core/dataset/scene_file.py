# SPDX-License-Identifier: GPL-3.0-or-later
"""Save and load a :class:`~.scene.Scene`: ``scene.json`` and ``points.npz``, no pickles."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import numpy as np

from .. import limits
from ..array_file import read_arrays
from ..errors import DatasetError, ParseError
from ..files import read_json, write_bytes, write_json
from ..names import SHARED_VARIABLE
from ..report_warning import read_warnings
from .camera import Camera
from .scene import Scene, View
from .similarity import Similarity

VERSION = 1
SCENE_NAME = "scene.json"
POINTS_NAME = "points.npz"
MOST_POINTS_BYTES = 27 * limits.MAX_POINTS + 4096
"""Largest ``points.npz`` when unpacked: 24 bytes of position and 3 of colour a point, headers."""
_AGAIN = "Run the cameras stage again."


def save_scene(scene: Scene, folder: Path) -> None:
    """Write ``scene.json`` and ``points.npz`` into ``folder``."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        points=np.asarray(scene.points, np.float64),
        point_colors=np.asarray(scene.point_colors, np.uint8),
    )
    write_bytes(folder / POINTS_NAME, buffer.getvalue())
    write_json(folder / SCENE_NAME, scene_to_json(scene, folder))


def load_saved_scene(folder: Path) -> Scene:
    """Read what :func:`save_scene` wrote.

    Raises
    ------
    ParseError
        A file is missing, damaged or of another version.
    DatasetError
        A photo no longer exists.
    """
    path = folder / SCENE_NAME
    if not path.is_file():
        raise ParseError(path, "whole file", "the file is missing.", _AGAIN)
    return scene_from_json(read_json(path), folder)


def scene_to_json(scene: Scene, folder: Path | None = None) -> dict[str, Any]:
    """Return the scene without its points as plain JSON values.

    Paths inside ``folder``, or in a folder beside it, are written relative to it, so that a job
    folder can be moved; and those inside the folder that several computers share
    (``names.SHARED_VARIABLE``), which each sees elsewhere.
    """
    return {
        "version": VERSION,
        "world_from_scene": scene.world_from_scene.to_json(),
        "warnings": [warning.to_json() for warning in scene.warnings],
        "facts": scene.facts,
        "views": [
            {
                "camera": view.camera.to_json(),
                "photo": _written(view.photo_path, folder),
                "mask": None if view.mask_path is None else _written(view.mask_path, folder),
            }
            for view in scene.views
        ],
    }


def scene_from_json(values: Any, folder: Path) -> Scene:
    """Build a scene from :func:`scene_to_json`'s values and ``points.npz`` of ``folder``.

    Raises
    ------
    ParseError, DatasetError
    """
    path = folder / SCENE_NAME
    if not isinstance(values, dict) or values.get("version") != VERSION:
        raise ParseError(path, "version", f"version {VERSION} was expected.", _AGAIN)
    try:
        views = tuple(
            View(
                Camera.from_json(entry["camera"]),
                _read(entry["photo"], folder),
                None if entry["mask"] is None else _read(entry["mask"], folder),
            )
            for entry in values["views"]
        )
        world_from_scene = Similarity.from_json(values["world_from_scene"])
        warnings, facts = read_warnings(values["warnings"]), dict(values["facts"])
    except (KeyError, TypeError, ValueError) as error:
        raise ParseError(path, "views", f"not as expected ({error}).", _AGAIN) from None
    for view in views:
        for file in (view.photo_path, view.mask_path):
            if file is not None and not os.path.isfile(file):  # false for over-long names as well
                raise DatasetError(
                    f"Photo {file} no longer exists.", "Put it back, or start the job anew."
                )
    points, colors = _read_points(folder / POINTS_NAME)
    return Scene(views, points, colors, world_from_scene, warnings, facts)


def _written(path: Path, folder: Path | None) -> str:
    if folder is not None and path.is_relative_to(folder):
        return path.relative_to(folder).as_posix()
    if folder is not None and path.is_relative_to(folder.parent):  # frames of a video
        return f"../{path.relative_to(folder.parent).as_posix()}"
    shared = os.environ.get(SHARED_VARIABLE)
    if folder is not None and shared and _both_in(Path(shared), path, folder):
        return Path(os.path.relpath(path, folder)).as_posix()
    return str(path)


def _both_in(shared: Path, path: Path, folder: Path) -> bool:
    root = shared.resolve()
    return path.is_relative_to(root) and folder.resolve().is_relative_to(root)


def _read(written: str, folder: Path) -> Path:
    """Return the path that :func:`_written` wrote, without ``..``."""
    return Path(os.path.normpath(folder / written))


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    arrays = read_arrays(
        path, ("points", "point_colors"), most_bytes=MOST_POINTS_BYTES, hint=_AGAIN
    )
    points, colors = arrays["points"], arrays["point_colors"]
    good = (
        points.dtype == np.float64
        and colors.dtype == np.uint8
        and points.ndim == 2
        and points.shape[1:] == (3,)
        and points.shape == colors.shape
        and bool(np.isfinite(points).all())
    )
    if not good:
        raise ParseError(path, "arrays", "not (n, 3) finite points and colours.", _AGAIN)
    return points, colors
