# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene: views with their photos and cameras, points, frame."""

from __future__ import annotations

import dataclasses
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import numpy as np

from .. import limits
from ..array_file import read_arrays
from ..errors import DatasetError, ParseError
from ..files import read_json, write_bytes, write_json
from ..limits import POINT_REACH
from ..names import SHARED_VARIABLE
from ..progress import ReportWarning, read_warnings
from .camera import Camera, Similarity

# -- Protocol of a source of photos, masks and matching cameras -----------------------------------


class PhotoSource(Protocol):
    """Cameras, photos and masks of the scene's views, downsampled by integer divisors.

    Implemented by :class:`~.store.PhotoStore`.
    """

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera that fits ``photo(index, divisor)`` pixel for pixel."""

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return (h, w, 3) uint8."""

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        """Return (h, w) bool, true where the photo counts, or ``None``."""


# -- The scene: undistorted views, sparse points, and the transform from the scene frame ----------


def usable_points(points: np.ndarray) -> np.ndarray:
    """Tell which sparse points (n, 3), scene frame, are finite and within reach, (n,) bool.

    The reach is ``limits.POINT_REACH``.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return np.linalg.norm(points, axis=1) <= POINT_REACH


BACKGROUND_SHARE = 0.75
"""Share of the photos whose mask was made, of what turns or of an object, for masks to mean
background."""
MASKS_MADE = "photos_masked_to_object"
"""Fact of a scene: photos with a mask made of a region or by a model."""


@dataclass(frozen=True)
class View:
    """One photo that matches its pinhole camera pixel for pixel."""

    camera: Camera
    photo_path: Path
    mask_path: Path | None = None
    """Greyscale image of the same size; black pixels are ignored."""


@dataclass(frozen=True)
class Scene:
    """Views and sparse points in the scene frame.

    The scene frame is Z-up (automatic up direction), has the mean of the camera centres at 0, and
    is scaled so that 1.1 x the largest camera distance to 0 is ``limits.SCENE_RADIUS``.
    ``world_from_scene`` maps back to the frame of the input, in float64.
    """

    views: tuple[View, ...]
    points: np.ndarray
    """(n, 3) float64 sparse points, scene frame; may be empty."""
    point_colors: np.ndarray
    """(n, 3) uint8."""
    world_from_scene: Similarity
    warnings: tuple[ReportWarning, ...] = ()
    """Warnings for the user."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Kind of input and counts, for the report."""

    def mask_mode(self, chosen: str) -> Literal["ignore", "background"]:
        """Return what the masks exclude, for a setting of :class:`~..settings.TrainingSettings`."""
        if chosen == "auto":
            turning = self.facts.get("photos_masked_as_turning") or 0
            masked = max(turning, self.facts.get(MASKS_MADE) or 0)
            return "background" if masked > BACKGROUND_SHARE * len(self.views) else "ignore"
        return "background" if chosen == "background" else "ignore"

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of all views, in order."""
        return [view.camera for view in self.views]


# -- Which views of a scene are held out, which are trained on, and a few of many -----------------

FEW_PHOTOS = 8
"""Below this number of photos, only one is held out."""

_Item = TypeVar("_Item")


def held_out_views(scene: Scene, every: int) -> list[int]:
    """Return the held-out views, which are measured and never trained on.

    Every n-th photo sorted by name; only the first with fewer than :data:`FEW_PHOTOS` photos; none
    if ``every`` is 0 or too few photos would be left.
    """
    count = len(scene.views)
    if every <= 0 or count < 3:
        return []
    ranked = sorted(range(count), key=lambda i: (scene.views[i].camera.name, i))
    if count < FEW_PHOTOS or every == 1:
        return ranked[:1]
    return sorted(ranked[::every])


def training_views(scene: Scene, photos: PhotoSource, every: int) -> list[int]:
    """Return the views that are trained on: not held out, and not covered by their mask."""
    held_out = set(held_out_views(scene, every))
    rest = [i for i in range(len(scene.views)) if i not in held_out]
    return [i for i in rest if (mask := photos.mask(i, 1)) is None or bool(mask.any())]


def evenly_spaced(items: Sequence[_Item], most: int) -> list[_Item]:
    """Return up to ``most`` evenly spaced items, including the first and the last."""
    positions = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(np.int64)
    return [items[position] for position in positions.tolist()]


# -- Save and load a :class:`~.scene.Scene`: ``scene.json`` and ``points.npz``, no pickles --------

VERSION = 1
SCENE_NAME = "scene.json"
POINTS_NAME = "points.npz"
MOST_POINTS_BYTES = 27 * limits.MAX_POINTS + 4096
"""Largest ``points.npz`` when unpacked: 24 bytes of position and 3 of colour a point, headers."""
_AGAIN = "Run the cameras stage again."


def save_scene(scene: Scene, folder: Path) -> None:
    """Write ``scene.json`` and ``points.npz`` into ``folder``."""
    points, colors = np.asarray(scene.points, np.float64), np.asarray(scene.point_colors, np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, points=points, point_colors=colors)
    write_bytes(folder / POINTS_NAME, buffer.getvalue())
    write_json(folder / SCENE_NAME, _scene_to_json(scene, folder))


def _scene_to_json(scene: Scene, folder: Path) -> dict[str, Any]:
    """Return the scene without its points as plain JSON values.

    Paths inside ``folder``, or in a folder beside it, are written relative to it, so that a job
    folder can be moved; and those inside the folder that several computers share
    (``names.SHARED_VARIABLE``), which each sees elsewhere.
    """
    views = []
    for view in scene.views:
        mask = None if view.mask_path is None else _written(view.mask_path, folder)
        photo = _written(view.photo_path, folder)
        views.append({"camera": view.camera.to_json(), "photo": photo, "mask": mask})
    return {
        "version": VERSION, "world_from_scene": scene.world_from_scene.to_json(),
        "warnings": [warning.to_json() for warning in scene.warnings],
        "facts": scene.facts, "views": views,
    }  # fmt: skip


def load_saved_scene(folder: Path) -> Scene:
    """Read what :func:`save_scene` wrote.

    Raises ParseError: a file is missing, damaged or of another version; DatasetError: a photo no
    longer exists.
    """
    path = folder / SCENE_NAME
    if not path.is_file():
        raise ParseError(path, "whole file", "the file is missing.", _AGAIN)
    values = read_json(path)
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
                hint = "Put it back, or start the job anew."
                raise DatasetError(f"Photo {file} no longer exists.", hint)
    points, colors = _read_points(folder / POINTS_NAME)
    return Scene(views, points, colors, world_from_scene, warnings, facts)


def _written(path: Path, folder: Path) -> str:
    if path.is_relative_to(folder):
        return path.relative_to(folder).as_posix()
    if path.is_relative_to(folder.parent):  # frames of a video
        return f"../{path.relative_to(folder.parent).as_posix()}"
    if shared := os.environ.get(SHARED_VARIABLE):
        root = Path(shared).resolve()
        if path.is_relative_to(root) and folder.resolve().is_relative_to(root):
            return Path(os.path.relpath(path, folder)).as_posix()
    return str(path)


def _read(written: str, folder: Path) -> Path:
    """Return the path that :func:`_written` wrote, without ``..``."""
    return Path(os.path.normpath(folder / written))


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    names = ("points", "point_colors")
    arrays = read_arrays(path, names, most_bytes=MOST_POINTS_BYTES, hint=_AGAIN)
    points, colors = (arrays[name] for name in names)
    of_kind = points.dtype == np.float64 and colors.dtype == np.uint8
    of_shape = points.ndim == 2 and points.shape[1:] == (3,) and points.shape == colors.shape
    if not (of_kind and of_shape and np.isfinite(points).all()):
        raise ParseError(path, "arrays", "not (n, 3) finite points and colours.", _AGAIN)
    return points, colors


# -- A saved scene with the camera poses that training refined ------------------------------------

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

    ``cameras``, ``training``: folders of the two stages.
    Raises ParseError: a file is missing, truncated or of another version, or the poses are none;
    DatasetError: a photo no longer exists.
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
