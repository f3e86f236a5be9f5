# SPDX-License-Identifier: GPL-3.0-or-later
"""A saved scene with the camera poses that training refined."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import numpy as np

from ..array_file import read_arrays
from ..errors import ParseError
from ..files import write_bytes
from .scene import Scene
from .scene_file import load_saved_scene

POSES_NAME = "camera_poses.npz"
ROTATION_TOLERANCE = 1e-6
"""Largest deviation of a rotation times its transpose from the identity."""

_HINT = "Delete the folder and run the job again."


def save_poses(folder: Path, poses: np.ndarray | None) -> None:
    """Write (views, 3, 4) float64 ``cam_from_world`` of all views, scene frame.

    ``None`` where poses stay as given: those of an interrupted run, perhaps on another device, that
    had refined them are removed.
    """
    if poses is None:
        (folder / POSES_NAME).unlink(missing_ok=True)
        return
    stream = io.BytesIO()
    np.savez(stream, cam_from_world=np.asarray(poses, np.float64))
    write_bytes(folder / POSES_NAME, stream.getvalue())


def load_refined_scene(cameras: Path, training: Path) -> Scene:
    """Read a scene as its training left it: with refined poses, where there are any.

    Parameters
    ----------
    cameras, training : Path
        Folders of the two stages.

    Raises
    ------
    ParseError
        A file is missing, truncated or of another version, or the poses are none.
    DatasetError
        A photo no longer exists.
    """
    scene = load_saved_scene(cameras)
    path = training / POSES_NAME
    if not path.is_file():
        return scene
    poses = read_arrays(path, ("cam_from_world",), hint=_HINT)["cam_from_world"]
    good = poses.dtype == np.float64 and poses.shape == (len(scene.views), 3, 4)
    if good:
        turns = poses[:, :, :3]
        off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3))
        good = bool(np.isfinite(poses).all() and (off < ROTATION_TOLERANCE).all())
    if not good:
        raise ParseError(path, "cam_from_world", "not a pose for each photo.", _HINT)
    return with_poses(scene, poses)


def with_poses(scene: Scene, poses: np.ndarray) -> Scene:
    """Return a scene with other poses, (views, 3, 4) ``cam_from_world`` in the scene frame."""
    views = tuple(
        dataclasses.replace(view, camera=dataclasses.replace(view.camera, cam_from_world=pose))
        for view, pose in zip(scene.views, poses, strict=True)
    )
    return dataclasses.replace(scene, views=views)
