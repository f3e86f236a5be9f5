# SPDX-License-Identifier: GPL-3.0-or-later
"""Read ``cameras.sfm`` and ``sfm.json`` of Meshroom (AliceVision), and landmarks if there are any.

Numbers are written as text. A pose's rotation leads from world to camera (x right, y down, z
forward) and is written column by column; ``center`` is the camera's. AliceVision counts pixels from
the first one's centre: half a pixel is added here.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..files import read_json
from ..scene.camera import pose_at
from .program_values import CameraFile, PhotoList, fisheye_lens, relative_names
from .source_model import Brown, LensCamera, SourceModel

KIND = "Meshroom cameras"

_MAX_BYTES = 64 * 1024 * 1024
"""A landmark takes about 0.6 kB with its observations: 256 MB are 400 000 of them."""
_JSON_NAMES = ("sfm.json", "sfmdata.json")
"""In small letters; other programs have an ``sfm_data.json`` of another content."""
_HALF_PIXEL = 0.5
_OTHER_LENS = (
    "Choose the camera type pinhole, radial3, brown or fisheye in Meshroom, and solve again."
)
_OLD_TYPES = {
    "pinhole": "none", "radial1": "radialk1", "radial3": "radialk3", "brown": "brown",
    "fisheye": "fisheye4", "fisheye4": "fisheye4",
}  # fmt: skip
"""Before version 1.2.6 the type of an intrinsic named its distortion."""
_COUNTS = {"none": 0, "radialk1": 1, "radialk3": 3, "brown": 5, "fisheye4": 4}


def is_meshroom(path: Path) -> bool:
    """Whether a file is named as the program names its cameras."""
    name = path.name.lower()
    return path.is_file() and (name.endswith(".sfm") or name in _JSON_NAMES)


def read_meshroom(path: Path) -> SourceModel:
    """Read views with their intrinsics and poses, and landmarks.

    Raises ParseError, which names the entry, such as ``intrinsics[0].type``; DatasetError: no photo
    is usable.
    """
    file = CameraFile(path)
    values = read_json(path, most_bytes=_MAX_BYTES, follow_links=True)
    if not isinstance(values, dict) or "views" not in values:
        raise file.wrong("top level", "an object with views was expected.")
    version = tuple(
        int(file.number("version", part)) for part in _list(file, values, "version") or (1, 0, 0)
    )
    views = _list(file, values, "views")
    photos = PhotoList(path)
    photos.check_count("views", len(views))
    poses = _poses(file, _list(file, values, "poses"))
    intrinsics = {
        str(entry.get("intrinsicId")): (f"intrinsics[{i}]", entry)
        for i, entry in enumerate(_list(file, values, "intrinsics"))
    }
    lenses: dict[str, LensCamera] = {}
    names = relative_names(str(view.get("path", "")) for view in views)
    for i, view in enumerate(views):
        name = names[str(view.get("path", ""))]
        pose_id, lens_id = str(view.get("poseId")), str(view.get("intrinsicId"))
        if pose_id not in poses:
            photos.leave_out(name, "not being placed")
            continue
        if "rigId" in view and str(view["rigId"]) != str(2**32 - 1):
            raise file.unsupported(f"views[{i}].rigId", "a rig", "Solve without rigs.")
        if lens_id not in lenses:
            if lens_id not in intrinsics:
                place = f"views[{i}].intrinsicId"
                raise file.wrong(place, "not among the intrinsics.")
            lenses[lens_id] = _lens(file, *intrinsics[lens_id], version)
        photos.add(name, lenses[lens_id], poses[pose_id])
    usable = photos.finished()
    landmarks = _list(file, values, "structure")
    named = ((f"structure[{i}]", entry) for i, entry in enumerate(landmarks))
    points, colors = file.points("structure", named, "X", len(landmarks))
    facts = {
        "views": len(views),
        "camera_models": sorted({lens.model for lens in lenses.values()}),
        "points_in_model": len(points),
    }
    return SourceModel(KIND, usable, points, colors, tuple(photos.warnings), facts)


def _list(file: CameraFile, values: dict[str, Any], key: str) -> list[Any]:
    """Return a list of the file, empty where it is missing or the text that stands for none."""
    found = values.get(key, [])
    if found == "":
        return []
    if not isinstance(found, list):
        raise file.wrong(key, "a list was expected.")
    if key != "version":
        for i, entry in enumerate(found):
            if not isinstance(entry, dict):
                raise file.wrong(f"{key}[{i}]", "an object was expected.")
    return found


def _poses(file: CameraFile, entries: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return (3, 4) cam_from_world of each pose's number."""
    poses = {}
    for i, entry in enumerate(entries):
        place = f"poses[{i}].pose.transform"
        pose = entry.get("pose")
        transform = pose.get("transform") if isinstance(pose, dict) else None
        if not isinstance(transform, dict):
            raise file.wrong(place, "an object was expected.")
        written = file.numbers(f"{place}.rotation", transform.get("rotation"), 9)
        turned = file.rotation(f"{place}.rotation", written.reshape(3, 3).T)
        center = file.numbers(f"{place}.center", transform.get("center"), 3)
        poses[str(entry.get("poseId"))] = pose_at(turned, center)
    return poses


def _lens(
    file: CameraFile, place: str, entry: dict[str, Any], version: tuple[int, ...]
) -> LensCamera:
    width, height = file.image_size(place, entry.get("width"), entry.get("height"))
    written = str(entry.get("type", "pinhole"))
    kind = str(entry.get("distortionType", _OLD_TYPES.get(written, "")))
    if written not in _OLD_TYPES or kind not in _COUNTS:
        raise file.unsupported(f"{place}.type", f"the lens {written} {kind}".strip(), _OTHER_LENS)
    if str(entry.get("undistortionType", "none")) != "none":
        raise file.unsupported(f"{place}.undistortionType", "a lens grid", _OTHER_LENS)
    focal = _focal(file, place, entry, version, width)
    principal = file.numbers(f"{place}.principalPoint", entry.get("principalPoint"), 2)
    if version >= (1, 2, 1):
        principal = principal + np.array([0.5 * width, 0.5 * height])
    center = float(principal[0]) + _HALF_PIXEL, float(principal[1]) + _HALF_PIXEL
    params = entry.get("distortionParams") or []
    k = file.numbers(f"{place}.distortionParams", params, _COUNTS[kind]).tolist()
    if kind == "fisheye4":
        lens = fisheye_lens(width, height, focal, center, (k[0], k[1], k[2], k[3]))
    else:
        brown = Brown(k[0], k[1], k[2], p1=k[3], p2=k[4]) if kind == "brown" else Brown(*k)
        lens = brown.lens(width, height, focal, center)
    return file.lens(place, lens)


def _focal(
    file: CameraFile, place: str, entry: dict[str, Any], version: tuple[int, ...], width: int
) -> tuple[float, float]:
    """Return the focal lengths in pixels, which versions of the file write in four ways."""
    if version < (1, 2, 2):
        written = entry.get("pxFocalLength")
        if isinstance(written, list):
            fx, fy = file.numbers(f"{place}.pxFocalLength", written, 2)
            return float(fx), float(fy)
        fx = file.number(f"{place}.pxFocalLength", written)
        return fx, fx
    length = file.number(f"{place}.focalLength", entry.get("focalLength"))
    sensor = file.number(f"{place}.sensorWidth", entry.get("sensorWidth", "36"))
    ratio = file.number(f"{place}.pixelRatio", entry.get("pixelRatio", "1"))
    if not (length > 0 and sensor > 0 and ratio > 0):
        raise file.wrong(f"{place}.focalLength", "a length is not positive.")
    fx = length / sensor * width
    return fx, fx * ratio if version >= (1, 2, 5) else fx / ratio
