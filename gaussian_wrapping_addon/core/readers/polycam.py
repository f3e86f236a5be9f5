# SPDX-License-Identifier: GPL-3.0-or-later
"""Read the raw data of Polycam: ``keyframes/corrected_cameras/*.json``, else ``keyframes/cameras``.

``t_00`` to ``t_23`` are the rows of the matrix from camera (ARKit's axes: x right, y up, z back) to
world (y up); ``fx``, ``fy``, ``cx``, ``cy`` are pixels of a photo of ``width`` x ``height``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .. import limits
from ..errors import ParseError
from ..files import read_json
from ..photos.formats import PHOTO_SUFFIXES
from ..scene.camera import pose_at
from .program_values import OPENGL_FROM_COLMAP, CameraFile, PhotoList
from .source_model import LensCamera, SourceModel

KIND = "Polycam keyframes"

_PAIRS = (
    ("corrected_cameras", "corrected_images"),
    ("corrected_cameras", "images"),
    ("cameras", "images"),
)
"""Folders of cameras and of their photos below ``keyframes``, the best first: corrected by the
program's own optimisation."""
_MAX_BYTES = 1024 * 1024


def polycam_folders(source: Path) -> tuple[Path, Path] | None:
    """Return the folders of the cameras and of their photos that ``source`` is or holds."""
    for root in (source / "keyframes", source, source.parent):
        if root.name != "keyframes":
            continue
        for cameras, photos in _PAIRS:
            if (root / cameras).is_dir() and (root / photos).is_dir():
                return root / cameras, root / photos
    return None


def read_polycam(cameras: Path, photo_folder: Path) -> SourceModel:
    """Read one camera a file; there are no points.

    Raises ParseError, which names the file and the entry; DatasetError: no photo is usable.
    """
    files = []
    for path in cameras.iterdir():
        if path.suffix.lower() == ".json" and not path.name.startswith("."):
            files.append(path)
            if len(files) > limits.MAX_IMAGES:
                raise ParseError(cameras, "files", "there are too many.", "Split the capture.")
    photos = PhotoList(photo_folder / cameras.name)
    for path in sorted(files):
        file = CameraFile(path)
        values = read_json(path, most_bytes=_MAX_BYTES, follow_links=True)
        if not isinstance(values, dict):
            raise file.wrong("top level", "an object was expected.")

        def value(name: str, file: CameraFile = file, values: dict[str, Any] = values) -> float:
            return file.number(name, values.get(name))

        matrix = np.array([[value(f"t_{row}{column}") for column in range(4)] for row in range(3)])
        world_from_camera = file.rotation("t_00 to t_22", matrix[:, :3])
        pose = pose_at((world_from_camera @ OPENGL_FROM_COLMAP).T, matrix[:, 3])
        width, height = file.image_size("photo", values.get("width"), values.get("height"))
        params = value("fx"), value("fy"), value("cx"), value("cy")
        lens = file.lens("photo", LensCamera("PINHOLE", width, height, params))
        photos.add(_photo_name(photo_folder, path.stem), lens, pose)
    photos.check_count("files", len(files))
    usable = photos.finished()
    facts = {"cameras": cameras.name, "files": len(files)}
    return SourceModel(KIND, usable, warnings=tuple(photos.warnings), facts=facts)


def _photo_name(folder: Path, stem: str) -> str:
    """Return the name of the photo of a camera file; its stem where there is none."""
    names = (f"{stem}{suffix}" for suffix in PHOTO_SUFFIXES)
    return next((name for name in names if (folder / name).is_file()), stem)
