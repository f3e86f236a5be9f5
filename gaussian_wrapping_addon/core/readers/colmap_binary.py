# SPDX-License-Identifier: GPL-3.0-or-later
"""Bounded reader of COLMAP's binary files: every count is checked against the bytes left.

The commonly used reader loops forever on a file truncated inside a name and accepts NaN, so the
format is read here, following its specification.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import limits
from ..errors import ParseError
from ..files import open_regular
from ..progress import ReportWarning
from .source_model import LENS_NAMES, LENS_PARAMETERS, LensCamera

AGAIN = "Export the model again, or solve the cameras from the photos."

_CAMERA_HEAD_BYTES = 24
_IMAGE_BYTES = 64 + 1 + 8
"""Smallest image record: fixed part, an empty name's NUL, the count of 2D points."""
_POINT2D_BYTES = 24
_POINT_BYTES = 51
_TRACK_BYTES = 8
_LONGEST_NAME_BYTES = 64 * 1024
"""Names are validated later; with a longer one the file is not a model."""

EQUIRECTANGULAR = 17


@dataclass(frozen=True)
class RawImage:
    """One image record before validation: values may be NaN, the name may be unsafe."""

    image_id: int
    quaternion: np.ndarray
    """(4,) float64, w x y z."""
    translation: np.ndarray
    """(3,) float64."""
    camera_id: int
    name: str
    place: str
    observed: int = 0
    """Sparse points that it sees."""


@dataclass(frozen=True)
class RawPoints:
    """Sparse points as stored."""

    positions: np.ndarray
    """(n, 3) float64."""
    colors: np.ndarray
    """(n, 3) uint8."""
    errors: np.ndarray
    """(n,) float64, mean reprojection error in pixels."""
    track_lengths: np.ndarray
    """(n,) int64."""


class _Cursor:
    """A bounds-checked read position in a file's bytes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with open_regular(path, follow_links=True) as stream:
                self.data = stream.read()
        except OSError as error:
            text = f"cannot be read: {error.strerror}."
            raise ParseError(path, "whole file", text, AGAIN) from None
        self.at = 0

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def fail(self, message: str) -> ParseError:
        return ParseError(self.path, f"byte {self.at}", message, AGAIN)

    def take(self, layout: struct.Struct, what: str) -> tuple[float, ...]:
        if self.left < layout.size:
            raise self.fail(f"the file ends inside {what}.")
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def count(self, record_bytes: int, most: int, what: str) -> int:
        """Read a 64-bit count; raise if the rest of the file cannot hold as many records."""
        begin = self.at
        (number,) = self.take(_COUNT, f"the number of {what}")
        if number > self.left // record_bytes:
            text = f"{number} {what} are announced, but only {self.left} bytes follow."
        elif number > most:
            text = f"{number} {what} are more than the limit of {most}."
        else:
            return int(number)
        self.at = begin
        raise self.fail(text)

    def name(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME_BYTES)
        if end < 0:
            raise self.fail("an image name does not end: the file is cut or not a model.")
        raw = self.data[self.at : end]
        self.at = end + 1
        return raw.decode(errors="surrogateescape")


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3Bd")
_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_NO_POINT = -1


def read_cameras(path: Path) -> tuple[dict[int, LensCamera], list[ReportWarning]]:
    """Read ``cameras.bin``.

    Returns cameras by their numbers, and warnings.
    Raises ParseError with the byte offset: cut file, impossible count, unknown model, unusable
    parameters.
    """
    cursor = _Cursor(path)
    number = cursor.count(_CAMERA_HEAD_BYTES + 3 * 8, limits.MAX_IMAGES, "cameras")
    cameras: dict[int, LensCamera] = {}
    for _ in range(number):
        begin = cursor.at
        camera_id, model_id, width, height = (int(v) for v in cursor.take(_CAMERA, "a camera"))
        place = f"byte {begin}, camera {camera_id}"
        if not 0 <= model_id < len(LENS_NAMES):
            named = "EQUIRECTANGULAR" if model_id == EQUIRECTANGULAR else f"number {model_id}"
            raise ParseError(
                path, place, f"camera model {named} is not supported.",
                "Convert the photos to perspective images, or solve the cameras again.",
            )  # fmt: skip
        model = LENS_NAMES[model_id]
        layout = struct.Struct(f"<{len(LENS_PARAMETERS[model])}d")
        camera = LensCamera(model, width, height, cursor.take(layout, f"camera {camera_id}"))
        add_camera(cameras, camera_id, camera, path, place)
    return cameras, _rest(cursor)


def add_camera(
    cameras: dict[int, LensCamera], camera_id: int, camera: LensCamera, path: Path, place: str
) -> None:
    """Add a camera to ``cameras``; raise :class:`ParseError` if it is invalid."""
    if problem := camera.problem():
        raise ParseError(path, place, f"{problem}.", "Solve the cameras again.")
    if cameras.get(camera_id, camera) != camera:
        raise ParseError(path, place, f"camera {camera_id} is defined twice.", AGAIN)
    cameras[camera_id] = camera


def read_images(path: Path) -> tuple[list[RawImage], list[ReportWarning]]:
    """Read ``images.bin``; of the 2D points, those with a sparse point are counted.

    Raises ParseError with the byte offset where the file ends or a count cannot be true.
    """
    cursor = _Cursor(path)
    number = cursor.count(_IMAGE_BYTES, limits.MAX_IMAGES, "images")
    images = []
    for _ in range(number):
        begin = cursor.at
        values = cursor.take(_IMAGE, "an image")
        name = cursor.name()
        points = cursor.count(_POINT2D_BYTES, 2**31, f"2D points of image {name!r}")
        entries = np.frombuffer(cursor.data, _POINT2D, points, cursor.at)
        observed = int((entries["point"] != _NO_POINT).sum())
        cursor.at += points * _POINT2D_BYTES
        quaternion, translation = np.array(values[1:5]), np.array(values[5:8])
        image_id, camera_id, place = int(values[0]), int(values[8]), f"byte {begin}"
        images.append(RawImage(image_id, quaternion, translation, camera_id, name, place, observed))
    return images, _rest(cursor)


def read_points(path: Path) -> tuple[RawPoints, list[ReportWarning]]:
    """Read ``points3D.bin``; tracks are skipped, their lengths kept.

    Raises ParseError with the byte offset where the file ends or a count cannot be true.
    """
    cursor = _Cursor(path)
    number = cursor.count(_POINT_BYTES, limits.MAX_POINTS, "points")
    positions, colors = np.zeros((number, 3)), np.zeros((number, 3), np.uint8)
    errors, lengths = np.zeros(number), np.zeros(number, np.int64)
    for i in range(number):
        values = cursor.take(_POINT, f"point {i}")
        track = cursor.count(_TRACK_BYTES, 2**31, f"observations of point {i}")
        cursor.at += track * _TRACK_BYTES
        positions[i], colors[i] = values[1:4], values[4:7]
        errors[i], lengths[i] = values[7], track
    return RawPoints(positions, colors, errors, lengths), _rest(cursor)


def _rest(cursor: _Cursor) -> list[ReportWarning]:
    if cursor.left == 0:
        return []
    text = f"{cursor.path.name} has {cursor.left} bytes after its last record; they were ignored."
    return [ReportWarning("bytes-after-last-record", text)]
