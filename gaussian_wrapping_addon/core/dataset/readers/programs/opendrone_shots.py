# SPDX-License-Identifier: GPL-3.0-or-later
"""Read ``shots.geojson`` with ``cameras.json`` of OpenDroneMap: what its archive of results holds.

A shot's ``translation`` is the camera's centre in the map's metres, ``rotation`` (axis times angle)
leads from there to the camera. Lenses are in ``cameras.json``; a shot names its lens by photo size
and focal length only.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ....errors import DatasetError, ParseError
from ....files import read_json
from ..source_model import LensCamera, SourceModel
from .opensfm import lens_of, rotation_of
from .photo_list import PhotoList, relative_names
from .values import AGAIN, image_size, number, numbers, pose_at

KIND = "OpenDroneMap shots"

SHOTS, CAMERAS = "shots.geojson", "cameras.json"
_FOCAL_TOLERANCE = 1e-6
"""Of the focal length that names a lens, as a share of the photo: both files write all digits."""


def is_shots(path: Path) -> bool:
    """Whether a file is named as the program names its shots."""
    return path.name.lower() == SHOTS and path.is_file()


def read_shots(path: Path) -> SourceModel:
    """Read shots and their lenses; there are no points.

    Raises
    ------
    ParseError
        Names the entry, such as ``features[3].rotation``.
    DatasetError
        ``cameras.json`` is missing, or no photo is usable.
    """
    values = read_json(path, follow_links=True)
    features = values.get("features") if isinstance(values, dict) else None
    if not isinstance(features, list):
        raise ParseError(path, "features", "a list was expected.", AGAIN)
    photos = PhotoList(path)
    photos.check_count("features", len(features))
    shots: list[dict[str, Any]] = []
    for i, feature in enumerate(features):
        shot = feature.get("properties") if isinstance(feature, dict) else None
        if not isinstance(shot, dict) or not isinstance(shot.get("filename"), str):
            raise ParseError(path, f"features[{i}]", "a shot with a filename was expected.", AGAIN)
        shots.append(shot)
    cameras = _cameras(path)
    names = relative_names(shot["filename"] for shot in shots)
    for i, shot in enumerate(shots):
        place = f"features[{i}]"
        turned = rotation_of(numbers(path, f"{place}.rotation", shot.get("rotation"), 3))
        center = numbers(path, f"{place}.translation", shot.get("translation"), 3)
        lens = _lens(path, place, shot, cameras)
        photos.add(names[shot["filename"]], lens, pose_at(turned, center))
    usable = photos.finished()
    return SourceModel(
        KIND, usable, warnings=tuple(photos.warnings), facts={"shots": len(features)}
    )


def _cameras(shots: Path) -> list[tuple[float, LensCamera]]:
    """Return focal length and lens of each camera of ``cameras.json``."""
    for folder in (shots.parent, shots.parent.parent):
        path = folder / CAMERAS
        if path.is_file():
            break
    else:
        raise DatasetError(
            f"{CAMERAS}, which holds the lenses of {shots.name}, is missing.",
            f"Put it beside {shots.name} or into the folder above.",
        )
    values = read_json(path, follow_links=True)
    if not isinstance(values, dict) or not values:
        raise ParseError(path, "top level", "an object of cameras was expected.", AGAIN)
    found = []
    for key, camera in values.items():
        place = repr(key[:80])
        if not isinstance(camera, dict):
            raise ParseError(path, place, "an object was expected.", AGAIN)
        lens = lens_of(path, place, camera)
        found.append((lens.focal[0] / max(lens.width, lens.height), lens))
    return found


def _lens(
    path: Path, place: str, shot: dict[str, Any], cameras: list[tuple[float, LensCamera]]
) -> LensCamera:
    size = image_size(path, place, shot.get("width"), shot.get("height"))
    focal = number(path, f"{place}.focal", shot.get("focal"))
    fitting = {
        lens
        for own, lens in cameras
        if (lens.width, lens.height) == size and abs(own - focal) <= _FOCAL_TOLERANCE
    }
    if len(fitting) != 1:
        raise ParseError(
            path, place, f"{len(fitting)} lenses of {CAMERAS} have its size and focal length.",
            "Give opensfm/reconstruction.json of the project instead.",
        )  # fmt: skip
    return fitting.pop()
