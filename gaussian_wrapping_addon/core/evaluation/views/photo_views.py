# SPDX-License-Identifier: GPL-3.0-or-later
"""Read photos with their cameras for mesh-based rendering: of a scene, or of a folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ...dataset.camera import Camera
from ...dataset.loading.source_kind import read_poses, source_kind
from ...dataset.loading.views import prepare_views
from ...dataset.photos.photo_store import PhotoStore
from ...dataset.scene import Scene, View
from ...dataset.similarity import Similarity
from ...errors import ParseError, UsageError
from ...files import read_json, resolve_inside
from ...progress import Progress
from .mesh_based_rendering import PhotoView

LONG_SIDE_PX = 800
"""Photos are reduced to this: as many of them as a capture has must fit into memory at once."""
TEST_CAMERAS = "cameras.json"
"""Cameras of a folder whose photos are in ``images/``; what the benchmarks' scenes have."""


def photo_views(
    scene: Scene, indices: Iterable[int], *, max_image_px: int = LONG_SIDE_PX
) -> list[PhotoView]:
    """Return photos of a scene in its world frame, black pixels of masks left out.

    Raises
    ------
    DatasetError
        A photo was changed or removed.
    """
    store = PhotoStore(scene, max_image_px)
    return [
        PhotoView(
            store.camera(index).moved(scene.world_from_scene),
            store.photo(index),
            store.mask(index),
        )
        for index in indices
    ]


def folder_scene(path: Path, work_folder: Path, progress: Progress, *, threads: int) -> Scene:
    """Return the photos of a folder, undistorted where needed, in the frame of their cameras.

    Parameters
    ----------
    path : Path
        COLMAP project, ``transforms.json``, or a folder with :data:`TEST_CAMERAS` and ``images/``.
    work_folder : Path
        Undistorted photos are written here.

    Raises
    ------
    UsageError
        The folder holds photos without cameras.
    DatasetError, ParseError
        It cannot be used.
    """
    if (path / TEST_CAMERAS).is_file():
        return _scene_of(_written_views(path))
    kind = source_kind(path)
    if kind.kind == "photos":
        raise UsageError(
            f"{path.name} holds photos without cameras.",
            "Give a COLMAP project or a transforms.json in the frame of the mesh.",
        )
    prepared, _, _ = prepare_views(
        read_poses(kind), kind, work_folder, progress, threads=threads
    )  # fmt: skip
    views = []
    for view in prepared:
        focal_x, focal_y, middle_x, middle_y = view.pinhole.params
        size = view.pinhole.width, view.pinhole.height
        camera = Camera(view.name, *size, focal_x, focal_y, middle_x, middle_y, view.cam_from_world)
        views.append(View(camera, view.photo_path, view.mask_path))
    return _scene_of(views)


def _scene_of(views: list[View]) -> Scene:
    none = np.zeros((0, 3))
    return Scene(tuple(views), none, none.astype(np.uint8), Similarity())


def _written_views(folder: Path) -> list[View]:
    path = folder / TEST_CAMERAS
    again = "Give a COLMAP project or a transforms.json instead."
    values = read_json(path, follow_links=True)
    entries = values.get("cameras") if isinstance(values, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ParseError(path, "cameras", "a list of cameras was expected.", again)
    views = []
    for number, entry in enumerate(entries):
        try:
            camera = Camera.from_json(entry)
        except (TypeError, ValueError, KeyError) as error:
            raise ParseError(
                path, f"camera {number}", f"not as expected ({error}).", again
            ) from None
        photo = resolve_inside(folder / "images", str(camera.name))
        if photo is None or not photo.is_file():
            raise ParseError(
                path, f"camera {number}", f"the photo images/{camera.name} is missing.", again
            )
        views.append(View(camera, photo))
    return views
