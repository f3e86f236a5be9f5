# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras of OpenSfM and OpenDroneMap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError
from ..files import read_json
from ..scene.camera import pose_at
from .program_values import CameraFile, PhotoList, fisheye_lens, relative_names
from .source_model import PANORAMA, Brown, LensCamera, SourceModel

# -- Read ``reconstruction.json`` of OpenSfM and OpenDroneMap -------------------------------------
#
# A shot's ``rotation`` (axis times angle) and ``translation`` lead from world to camera (x right,
# y down, z forward). Lengths in the image are shares of its long side, counted from its middle.

KIND = "OpenSfM reconstruction"

_MAX_BYTES = 64 * 1024 * 1024
"""A point takes about 120 bytes: 256 MB are two million of them."""
_OTHER_LENS = "Choose the camera type brown or perspective (ODM: --camera-lens), and solve again."
_PANORAMAS = ("spherical", "equirectangular")
_SAME_FOCAL = {"perspective", "fisheye"}
"""Types with one focal length and the principal point in the middle."""
_TYPES = (
    "perspective", "brown", "radial", "simple_radial", "fisheye", "fisheye_opencv",
)  # fmt: skip


def is_opensfm(path: Path) -> bool:
    """Whether a file is named as the program names its reconstructions."""
    name = path.name.lower()
    return name.startswith("reconstruction") and name.endswith(".json") and path.is_file()


def read_opensfm(path: Path) -> SourceModel:
    """Read the reconstruction with most shots, and its points.

    Raises ParseError, which names the entry, such as ``[0].shots['a.jpg'].rotation``; DatasetError:
    no photo is usable.
    """
    file = CameraFile(path)
    values = read_json(path, most_bytes=_MAX_BYTES, follow_links=True)
    entries = values if isinstance(values, list) else [values]
    if not entries or not all(isinstance(entry, dict) and "shots" in entry for entry in entries):
        raise file.wrong("top level", "a list of reconstructions was expected.")
    photos = PhotoList(path)
    counts = [len(_table(file, f"[{i}]", entry, "shots")) for i, entry in enumerate(entries)]
    chosen = int(np.argmax(counts))
    if len(entries) > 1:
        photos.warn(
            "several-models",
            f"The input holds {len(entries)} reconstructions; [{chosen}] with {counts[chosen]} "
            f"photos was used, {sum(counts) - counts[chosen]} photos are in others.",
            "Take photos that connect the parts, so that one reconstruction holds them all.",
        )
    place, entry = f"[{chosen}]", entries[chosen]
    shots = _table(file, place, entry, "shots")
    cameras = _table(file, place, entry, "cameras")
    photos.check_count(f"{place}.shots", len(shots))
    names = relative_names(shots)
    lenses: dict[str, LensCamera | None] = {}  # None: a panorama
    for name, shot in shots.items():
        here = f"{place}.shots[{name[:80]!r}]"
        if not isinstance(shot, dict):
            raise file.wrong(here, "an object was expected.")
        key = str(shot.get("camera"))
        if key not in lenses:
            camera = cameras.get(key)
            if not isinstance(camera, dict):
                raise file.wrong(f"{here}.camera", "it is not among the cameras.")
            lens = None
            if camera.get("projection_type") not in _PANORAMAS:
                lens = lens_of(file, f"{place}.cameras[{key[:80]!r}]", camera)
            lenses[key] = lens
        turned = rotation_of(file.numbers(f"{here}.rotation", shot.get("rotation"), 3))
        shift = file.numbers(f"{here}.translation", shot.get("translation"), 3)
        photos.add(names[name], lenses[key], np.concatenate([turned, shift[:, None]], 1))
    usable = photos.finished()
    table, here = _table(file, place, entry, "points"), f"{place}.points"
    named = ((f"{here}[{key[:80]!r}]", point) for key, point in table.items())
    points, colors = file.points(here, named, "coordinates", len(table))
    facts = {
        "reconstruction": chosen,
        "camera_models": sorted({lens.model if lens else PANORAMA for lens in lenses.values()}),
        "points_in_model": len(points),
    }
    return SourceModel(KIND, usable, points, colors, tuple(photos.warnings), facts)


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation of a (3,) vector: its axis times its angle in radians."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # sin(a) / a and (1 - cos(a)) / a^2, smooth at 0.
    first = float(np.sinc(angle / np.pi))
    second = 0.5 * float(np.sinc(0.5 * angle / np.pi)) ** 2
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def _table(file: CameraFile, place: str, entry: dict[str, Any], key: str) -> dict[str, Any]:
    found = entry.get(key, {})
    if not isinstance(found, dict):
        raise file.wrong(f"{place}.{key}", "an object was expected.")
    return found


def lens_of(file: CameraFile, place: str, camera: dict[str, Any]) -> LensCamera:
    """Return the lens of a camera of ``reconstruction.json`` or ``cameras.json``.

    Raises ParseError.
    """
    kind = str(camera.get("projection_type", "perspective"))
    if kind not in _TYPES:
        raise file.unsupported(f"{place}.projection_type", f"the lens {kind}", _OTHER_LENS)
    width, height = file.image_size(place, camera.get("width"), camera.get("height"))
    side = max(width, height)

    def value(name: str, default: float = 0.0) -> float:
        return file.number(f"{place}.{name}", camera.get(name, default))

    if kind in _SAME_FOCAL:
        if "focal" not in camera:
            raise file.wrong(f"{place}.focal", "the focal length is missing.")
        fx = fy = value("focal") * side
        center = 0.5 * width, 0.5 * height
    else:
        fx = value("focal_x", value("focal")) * side
        fy = value("focal_y", fx / side) * side
        center = 0.5 * width + value("c_x") * side, 0.5 * height + value("c_y") * side
    k1, k2, k3 = value("k1"), value("k2"), value("k3")
    known = width, height, (fx, fy), center
    if kind == "fisheye":
        lens = fisheye_lens(*known, (k1, k2, 0.0, 0.0))
    elif kind == "fisheye_opencv":
        lens = fisheye_lens(*known, (k1, k2, k3, value("k4")))
    elif kind == "brown":
        lens = Brown(k1, k2, k3, p1=value("p1"), p2=value("p2")).lens(*known)
    else:
        lens = Brown(k1, 0.0 if kind == "simple_radial" else k2).lens(*known)
    return file.lens(place, lens)


# -- Read ``shots.geojson`` with ``cameras.json``, as OpenDroneMap's archive of results has them --
#
# A shot's ``translation`` is the camera's centre in the map's metres, ``rotation`` (axis times
# angle) leads from there to the camera. Lenses are in ``cameras.json``; a shot names its lens by
# photo size and focal length only.

SHOTS_KIND = "OpenDroneMap shots"

SHOTS, CAMERAS = "shots.geojson", "cameras.json"
_FOCAL_TOLERANCE = 1e-6
"""Of the focal length that names a lens, as a share of the photo: both files write all digits."""


def is_shots(path: Path) -> bool:
    """Whether a file is named as the program names its shots."""
    return path.name.lower() == SHOTS and path.is_file()


def read_shots(path: Path) -> SourceModel:
    """Read shots and their lenses; there are no points.

    Raises ParseError, which names the entry, such as ``features[3].rotation``; DatasetError:
    ``cameras.json`` is missing, or no photo is usable.
    """
    file = CameraFile(path)
    values = read_json(path, follow_links=True)
    features = values.get("features") if isinstance(values, dict) else None
    if not isinstance(features, list):
        raise file.wrong("features", "a list was expected.")
    photos = PhotoList(path)
    photos.check_count("features", len(features))
    shots: list[dict[str, Any]] = []
    for i, feature in enumerate(features):
        shot = feature.get("properties") if isinstance(feature, dict) else None
        if not isinstance(shot, dict) or not isinstance(shot.get("filename"), str):
            raise file.wrong(f"features[{i}]", "a shot with a filename was expected.")
        shots.append(shot)
    cameras = _cameras(path)
    names = relative_names(shot["filename"] for shot in shots)
    for i, shot in enumerate(shots):
        place = f"features[{i}]"
        turned = rotation_of(file.numbers(f"{place}.rotation", shot.get("rotation"), 3))
        center = file.numbers(f"{place}.translation", shot.get("translation"), 3)
        photos.add(
            names[shot["filename"]], _lens(file, place, shot, cameras), pose_at(turned, center)
        )
    usable, facts = photos.finished(), {"shots": len(features)}
    return SourceModel(SHOTS_KIND, usable, warnings=tuple(photos.warnings), facts=facts)


def _cameras(shots: Path) -> list[tuple[float, LensCamera]]:
    """Return focal length and lens of each camera of ``cameras.json``."""
    for folder in (shots.parent, shots.parent.parent):
        path = folder / CAMERAS
        if path.is_file():
            break
    else:
        text = f"{CAMERAS}, which holds the lenses of {shots.name}, is missing."
        raise DatasetError(text, f"Put it beside {shots.name} or into the folder above.")
    file = CameraFile(path)
    values = read_json(path, follow_links=True)
    if not isinstance(values, dict) or not values:
        raise file.wrong("top level", "an object of cameras was expected.")
    found = []
    for key, camera in values.items():
        place = repr(key[:80])
        if not isinstance(camera, dict):
            raise file.wrong(place, "an object was expected.")
        lens = lens_of(file, place, camera)
        found.append((lens.focal[0] / max(lens.width, lens.height), lens))
    return found


def _lens(
    file: CameraFile, place: str, shot: dict[str, Any], cameras: list[tuple[float, LensCamera]]
) -> LensCamera:
    size = file.image_size(place, shot.get("width"), shot.get("height"))
    focal = file.number(f"{place}.focal", shot.get("focal"))
    fitting = {
        lens
        for own, lens in cameras
        if (lens.width, lens.height) == size and abs(own - focal) <= _FOCAL_TOLERANCE
    }
    if len(fitting) != 1:
        raise file.wrong(
            place, f"{len(fitting)} lenses of {CAMERAS} have its size and focal length.",
            "Give opensfm/reconstruction.json of the project instead.",
        )  # fmt: skip
    return fitting.pop()
