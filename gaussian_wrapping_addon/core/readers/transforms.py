# SPDX-License-Identifier: GPL-3.0-or-later
"""Read transforms.json of nerfstudio, instant-ngp and NeRF-synthetic.

World is the frame of the file's ``transform_matrix`` values as they are written. The matrices map
OpenGL camera axes (x right, y up, z back) to world; ours map world to COLMAP axes.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from .. import limits
from ..errors import DatasetError, ParseError
from ..files import read_json, resolve_inside
from ..progress import LEFT_OUT_HINT, ReportWarning
from ..scene.camera import pose_at
from .colmap import is_safe_name
from .point_files import read_point_ply
from .program_values import OPENGL_FROM_COLMAP, ROTATION_TOLERANCE
from .source_model import LENS_PARAMETERS, PANORAMA, LensCamera, PosedPhoto, SourceModel

NAMES = ("transforms.json", "transforms_train.json")

_LENSES = {
    "SIMPLE_PINHOLE": "PINHOLE", "PINHOLE": "PINHOLE", "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV", "OPENCV": "OPENCV", "FULL_OPENCV": "FULL_OPENCV",
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
}  # fmt: skip
_AGAIN = "Export the file again."


def find_transforms(source: Path) -> Path | None:
    """Return the transforms file that ``source`` is or holds."""
    if source.is_file():
        return source if source.suffix.lower() == ".json" else None
    return next((source / name for name in NAMES if (source / name).is_file()), None)


def read_transforms(path: Path) -> SourceModel:
    """Read poses, intrinsics and the start points that the file names.

    Raises ParseError: an entry is invalid; names it, such as ``frames[3].transform_matrix``;
    DatasetError: no usable frame.
    """
    values = read_json(path, follow_links=True)
    if not isinstance(values, dict):
        raise ParseError(path, "top level", "an object was expected.", _AGAIN)
    frames = values.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ParseError(path, "frames", "a list of at least one frame was expected.", _AGAIN)
    if len(frames) > limits.MAX_IMAGES:
        raise ParseError(path, "frames", f"{len(frames)} frames are too many.", "Split the file.")
    warnings: list[ReportWarning] = []
    photos: list[PosedPhoto] = []
    unsafe: list[str] = []
    repeated = scaled = 0
    seen: set[str] = set()
    for i, frame in enumerate(frames):
        place = f"frames[{i}]"
        if not isinstance(frame, dict):
            raise ParseError(path, place, "an object was expected.", _AGAIN)
        name = _name(path, f"{place}.file_path", frame.get("file_path"))
        if not is_safe_name(path.parent, name):
            unsafe.append(f"{name[:80]!r}")
            continue
        if name in seen:
            repeated += 1
            continue
        seen.add(name)
        pose, was_scaled = _pose(path, f"{place}.transform_matrix", frame.get("transform_matrix"))
        scaled += was_scaled
        intrinsics = {**values, **frame}
        is_panorama = intrinsics.get("camera_model") == PANORAMA
        lens, angle_x = (None, None) if is_panorama else _intrinsics(path, place, intrinsics)
        mask = frame.get("mask_path")
        if mask is not None:
            mask = _name(path, f"{place}.mask_path", mask)
        photos.append(PosedPhoto(name, lens, pose, mask, angle_x))
    if unsafe:
        text = (
            f"{len(unsafe)} frames were left out because their file_path is too long or leads "
            f"outside the folder: {', '.join(unsafe[:3])}."
        )
        warnings.append(ReportWarning("frames-outside-folder", text, LEFT_OUT_HINT))
    if repeated:
        text = f"{repeated} frames repeat a photo and were left out."
        warnings.append(ReportWarning("frames-repeated", text, LEFT_OUT_HINT))
    if scaled:
        text = f"{scaled} matrices held a scale, which was removed."
        warnings.append(ReportWarning("scale-removed", text))
    if not photos:
        text = f"None of the {len(frames)} frames of {path.name} is usable."
        raise DatasetError(text, " ".join([*(warning.text for warning in warnings), _AGAIN]))
    points, colors = _start_points(path, values.get("ply_file_path"), warnings)
    facts: dict[str, Any] = {
        "frames": len(frames),
        "camera_models": sorted({p.lens.model for p in photos if p.lens is not None})
        or [PANORAMA if photos[0].is_panorama else "PINHOLE"],
        "points_in_model": len(points),
    }
    if "applied_transform" in values or "applied_scale" in values:
        facts["world_frame"] = "of transform_matrix, with the file's applied_transform in it"
    return SourceModel("transforms.json", tuple(photos), points, colors, tuple(warnings), facts)


def _name(path: Path, place: str, value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ParseError(path, place, "a file name was expected.", _AGAIN)
    name = value.replace("\\", "/")
    while name.startswith("./"):
        name = name[2:]
    return name


def _pose(path: Path, place: str, value: Any) -> tuple[np.ndarray, bool]:
    """Return (3, 4) cam_from_world with COLMAP axes, and whether a scale was removed."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise ParseError(path, place, "4 x 4 (or 3 x 4) finite numbers were expected.", _AGAIN)
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise ParseError(path, place, "the last row must be 0 0 0 1.", _AGAIN)
    linear = matrix[:3, :3]
    with np.errstate(all="ignore"):  # of numbers near the ends of float64
        determinant = float(np.linalg.det(linear))
    if not math.isfinite(determinant):
        raise ParseError(path, place, "the matrix is not a rotation.", _AGAIN)
    if determinant < 0:
        raise ParseError(path, place, "the matrix mirrors.", "Export with right-handed axes.")
    scale = determinant ** (1.0 / 3.0)
    if scale < 1e-12:
        raise ParseError(path, place, "the matrix has no rotation.", _AGAIN)
    u, _, vt = np.linalg.svd(linear / scale)
    rotation = u @ vt  # nearest rotation, (3, 3)
    if np.abs(rotation - linear / scale).max() > ROTATION_TOLERANCE:
        raise ParseError(path, place, "the matrix is not a rotation.", _AGAIN)
    pose = pose_at((rotation @ OPENGL_FROM_COLMAP).T, matrix[:3, 3])
    return pose, abs(scale - 1.0) > ROTATION_TOLERANCE


def _intrinsics(
    path: Path, place: str, values: dict[str, Any]
) -> tuple[LensCamera | None, float | None]:
    """Return the lens, or ``None`` and the angle if the photo's size is needed to complete it."""

    def number(key: str) -> float | None:
        value = values.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ParseError(path, f"{place}.{key}", "a number was expected.", _AGAIN)
        try:
            found = float(value)
        except OverflowError:
            found = math.inf
        if not math.isfinite(found):
            raise ParseError(path, f"{place}.{key}", "the number is not finite.", _AGAIN)
        return found

    stated = str(values.get("camera_model", ""))
    if stated and stated not in _LENSES:
        raise ParseError(
            path, f"{place}.camera_model", f"{stated[:40]} is not supported.",
            f"Use one of {', '.join((*_LENSES, PANORAMA))}.",
        )  # fmt: skip
    if values.get("is_fisheye") is True:
        stated = "OPENCV_FISHEYE"
    k = {key: number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")}
    model = _LENSES.get(stated, "OPENCV")
    if model == "OPENCV" and k["k3"]:
        model = "FULL_OPENCV"
        if k["k4"] and stated != "FULL_OPENCV":
            # OpenCV's k4 divides, nerfstudio's multiplies r^8: not the same lens.
            raise ParseError(
                path, f"{place}.k4", "k4 is only known with OPENCV_FISHEYE or FULL_OPENCV.",
                "State camera_model, or leave k4 out.",
            )  # fmt: skip
    if model in ("OPENCV", "FULL_OPENCV") and not any(k.values()):
        model = "PINHOLE"
    width, height = number("w"), number("h")
    angle_x, angle_y = number("camera_angle_x"), number("camera_angle_y")
    fx, fy = number("fl_x"), number("fl_y")
    if fx is None and fy is None and (angle_x is None or not 0 < angle_x < math.pi):
        raise ParseError(
            path, place, "no focal length: neither fl_x nor a camera_angle_x from 0 to pi.",
            "Add fl_x and fl_y in pixels.",
        )  # fmt: skip
    if width is None or height is None:
        if fx is None and fy is None and model == "PINHOLE":
            return None, angle_x
        raise ParseError(path, place, "w and h are missing.", "Add the photo size in pixels.")
    if fx is None and fy is None:
        assert angle_x is not None
        fx = 0.5 * width / math.tan(0.5 * angle_x)
        if angle_y is not None and 0 < angle_y < math.pi:
            fy = 0.5 * height / math.tan(0.5 * angle_y)
    fx, fy = fx or fy, fy or fx
    cx, cy = number("cx"), number("cy")
    cx, cy = 0.5 * width if cx is None else cx, 0.5 * height if cy is None else cy
    known = {**k, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    params = tuple(float(known[name] or 0.0) for name in LENS_PARAMETERS[model])
    if not (1 <= width <= limits.MAX_IMAGE_SIDE_PX and 1 <= height <= limits.MAX_IMAGE_SIDE_PX):
        raise ParseError(path, place, f"image size {width:g} x {height:g} is out of range.", _AGAIN)
    lens = LensCamera(model, round(width), round(height), params)
    if problem := lens.problem():
        raise ParseError(path, place, f"{problem}.", _AGAIN)
    return lens, None


def _start_points(
    path: Path, name: Any, warnings: list[ReportWarning]
) -> tuple[np.ndarray, np.ndarray]:
    nothing = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    if name is None:
        return nothing
    found = resolve_inside(path.parent, name) if isinstance(name, str) and name else None
    if found is None or not os.path.isfile(found):
        text = f"ply_file_path {json.dumps(name)[:80]} was not found in the folder."
        hint = "Put the file where transforms.json says it is."
        warnings.append(ReportWarning("point-file-missing", text, hint))
        return nothing
    return read_point_ply(found)
