# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras of RealityScan: CSV and XMP."""

from __future__ import annotations

import csv
import io
import math
import os
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from .. import limits
from ..files import read_bounded
from ..photos.finder import list_photos
from ..scene.camera import pose_at
from .program_values import (
    OPENGL_FROM_COLMAP,
    CameraFile,
    PhotoList,
    begins_with,
    read_xml,
    relative_names,
)
from .source_model import Brown, RelativeLens, SourceModel

# -- Read "Internal/External camera parameters" (CSV) of RealityScan and RealityCapture -----------
#
# A row holds the position, heading, pitch and roll in degrees, the focal length in millimetres of
# a film 36 mm wide, the principal point in shares of the photo's long side from its middle, and
# Brown's coefficients. Heading is clockwise from +y about +z; with all angles 0 the camera looks
# down and the photo's top is +y. The file states no photo sizes: lenses are completed when the
# photos are known.

KIND = "RealityScan CSV"

FILM_WIDTH_MM = 36.0
_FIRST_COLUMN = "#name"
_MAX_CSV_BYTES = 64 * 1024 * 1024
"""A row takes about 250 bytes: 64 MB are more photos than the limit."""
_SYNONYMS = {
    "yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py", "z": "alt",
}  # fmt: skip
"""Later versions of the program call the same columns otherwise."""
_NEEDED = ("x", "y", "alt", "heading", "pitch", "roll", "f")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_CHOOSE = 'Export "Internal/External camera parameters" as CSV.'


def is_csv_of_cameras(path: Path) -> bool:
    """Whether a CSV file begins with the column of photo names that the program writes."""
    start = begins_with(path, ".csv", 256)
    return start.removeprefix(b"\xef\xbb\xbf").lstrip().lower().startswith(b"#name")


def read_csv(path: Path) -> SourceModel:
    """Read the cameras of a CSV file; it holds no points.

    Raises ParseError, which names the line and the column; DatasetError: no photo is usable.
    """
    file = CameraFile(path)
    data = read_bounded(path, _MAX_CSV_BYTES, follow_links=True)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        place = f"byte {error.start}"
        raise file.wrong(place, "not UTF-8 text.", "Save it as UTF-8.") from None
    if "\0" in text:
        raise file.wrong("whole file", "not text.", _CHOOSE)
    rows = _rows(file, text)
    header = _header(file, rows[0][1] if rows else [])
    photos = PhotoList(path)
    photos.check_count("rows", len(rows) - 1)
    names = relative_names(row[header[_FIRST_COLUMN]] for _, row in rows[1:] if row)
    for line, row in rows[1:]:
        if len(row) < len(header):
            text = f"{len(row)} columns instead of {len(header)}."
            raise file.wrong(f"line {line}", text)

        def value(column: str, line: int = line, row: list[str] = row) -> float:
            if column not in header:
                return 0.0
            return file.number(f"line {line}, {column}", row[header[column]])

        world_from_camera = _world_from_opengl(
            *(math.radians(value(angle)) for angle in ("heading", "pitch", "roll"))
        )
        center = np.array([value("x"), value("y"), value("alt")])
        pose = pose_at((world_from_camera @ OPENGL_FROM_COLMAP).T, center)
        focal = value("f") / FILM_WIDTH_MM
        if focal <= 0:
            raise file.wrong(f"line {line}, f", "the focal length is not positive.")
        # The program's t1 and t2 are OpenCV's p2 and p1.
        brown = Brown(*(value(k) for k in ("k1", "k2", "k3", "k4", "t2", "t1")))
        lens = RelativeLens(focal, 1.0, (value("px"), value("py")), brown)
        photos.add(names[row[header[_FIRST_COLUMN]]], None, pose, relative=lens)
    usable = photos.finished()
    return SourceModel(KIND, usable, warnings=tuple(photos.warnings), facts={"rows": len(rows) - 1})


def _rows(file: CameraFile, text: str) -> list[tuple[int, list[str]]]:
    """Return the rows that are not empty, with their lines."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows = []
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append((reader.line_num, [cell.strip() for cell in row]))
            if len(rows) > limits.MAX_IMAGES + 1:
                raise file.wrong("rows", "there are too many.", "Split the project.")
    except csv.Error as error:
        raise file.wrong(f"line {reader.line_num}", f"not CSV: {error}.") from None
    return rows


def _header(file: CameraFile, cells: list[str]) -> dict[str, int]:
    """Return the column of each name."""
    names = [cell.lower() for cell in cells]
    names = [_SYNONYMS.get(name, name) for name in names]
    if not names or names[0] != _FIRST_COLUMN:
        raise file.wrong("line 1", "the column #name was expected first.", _CHOOSE)
    if len(set(names)) < len(names):
        raise file.wrong("line 1", "a column is there twice.", _CHOOSE)
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise file.wrong("line 1", f"columns are missing: {', '.join(missing)}.", _CHOOSE)
    known = {_FIRST_COLUMN, *_NEEDED, *_OPTIONAL}
    for name in names:
        if name not in known and name[:1] in ("k", "t", "s") and name[1:2].isdigit():
            raise file.unsupported("line 1", f"lens coefficient {name}", _CHOOSE)
    return {name: column for column, name in enumerate(names)}


def _world_from_opengl(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Return the (3, 3) rotation of a camera with OpenGL axes (x right, y up, z back)."""
    c, s = math.cos(heading), math.sin(heading)
    about_z = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    c, s = math.cos(pitch), math.sin(pitch)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    c, s = math.cos(roll), math.sin(roll)
    about_y = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return about_z @ about_x @ about_y


# -- Read XMP files beside the photos, as RealityScan and RealityCapture export them --------------
#
# ``xcr:Rotation`` leads from world to camera (x right, y down, z forward), row by row;
# ``xcr:Position`` is the camera's centre. Focal length in millimetres of a film 36 mm wide,
# principal point in shares of the photo's long side from its middle, distortion ``k1 k2 k3 k4 t1
# t2``.

XMP_KIND = "RealityScan XMP"

_MAX_XMP_BYTES = 1024 * 1024
"""An XMP file of a photo takes about 2 kB; with a thumbnail from elsewhere, hundreds."""
_MARK = b"capturingreality.com/ns/xcr"
_POSE = b"Rotation"
_NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_WITHOUT_HINT = "Export the cameras again, or move the XMP files away to have all cameras solved."
_BROWN = ("brown3", "brown4", "brown3t2", "brown4t2")
_PLAIN = "perspective"
_NO_DIVISION = "Choose Brown as the distortion model in the alignment's settings, align and export."


def xmp_files(root: Path) -> dict[Path, Path]:
    """Return the XMP files of the program beside photos under ``root``: of each photo, its file."""
    found: dict[Path, Path] = {}
    used: set[Path] = set()
    for photo in list_photos(root):
        for suffix in (".xmp", ".XMP"):
            path = photo.with_suffix(suffix)
            if os.path.isfile(path) and path not in used and _is_of_program(path):
                found[photo] = path
                used.add(path)
                break
    return found


def _is_of_program(path: Path) -> bool:
    """Whether the file has a pose of the program.

    Other programs write XMP files as well, and this one also writes files without any.
    """
    try:
        with path.open("rb") as stream:
            text = stream.read(_MAX_XMP_BYTES)
            return _MARK in text and _POSE in text
    except OSError:
        return False


def read_xmp_files(root: Path, files: dict[Path, Path]) -> SourceModel:
    """Read the XMP files of photos under ``root``; they hold no points.

    ``files``: as of :func:`xmp_files`.
    Raises ParseError: a file is broken; names it and the entry; DatasetError: no photo is usable.
    """
    photos = PhotoList(root / "the XMP files")
    posed: dict[str, list[tuple[str, np.ndarray, RelativeLens]]] = {}
    for photo, path in files.items():
        name = photo.relative_to(root).as_posix()
        file, entry = CameraFile(path), _description(path)
        matrix = None if entry is None else _value(entry, "Rotation")
        center = None if entry is None else _value(entry, "Position")
        if entry is None or matrix is None or center is None:
            photos.leave_out(name, "no pose in their XMP file")
            continue
        written = file.numbers("xcr:Rotation", matrix, 9).reshape(3, 3)
        turned = file.rotation("xcr:Rotation", written)
        pose = pose_at(turned, file.numbers("xcr:Position", center, 3))
        component = _value(entry, "ComponentId") or ""
        posed.setdefault(component, []).append((name, pose, _lens(file, entry)))
    chosen = max(posed.values(), key=len, default=[])
    for entries in posed.values():
        for name, pose, lens in entries:
            if entries is chosen:
                photos.add(name, None, pose, relative=lens)
            else:
                photos.leave_out(name, "another component than the largest")
    usable, facts = photos.finished(), {"files": len(files)}
    without = len(list_photos(root)) - len(files)
    if without > 0:
        text = f"{without} photos have no camera of RealityScan beside them and are left out."
        photos.warn("photos-without-camera", text, _WITHOUT_HINT)
    return SourceModel(XMP_KIND, usable, warnings=tuple(photos.warnings), facts=facts)


def _description(path: Path) -> Element | None:
    """Return the element that holds the program's values."""
    for element in read_xml(path, _MAX_XMP_BYTES).iter():
        names = (*element.attrib, *(child.tag for child in element))
        if any(name.startswith(_NAMESPACE) for name in names):
            return element
    return None


def _value(entry: Element, name: str) -> str | None:
    """Return a value, which may stand in an attribute or in an element."""
    value = entry.get(_NAMESPACE + name)
    return value if value is not None else entry.findtext(_NAMESPACE + name)


def _lens(file: CameraFile, entry: Element) -> RelativeLens:
    def value(name: str, default: str) -> float:
        text = _value(entry, name)
        return file.number(f"xcr:{name}", default if text is None else text)

    if _value(entry, "FocalLength35mm") is None:
        raise file.wrong("xcr:FocalLength35mm", "the focal length is missing.")
    focal = value("FocalLength35mm", "0") / FILM_WIDTH_MM
    aspect = value("AspectRatio", "1")
    if focal <= 0 or aspect <= 0:
        raise file.wrong("xcr:FocalLength35mm", "a length is not positive.")
    offset = value("PrincipalPointU", "0"), value("PrincipalPointV", "0")
    model = _value(entry, "DistortionModel") or _PLAIN
    text = _value(entry, "DistortionCoeficients") or "0 0 0 0 0 0"
    k1, k2, k3, k4, t1, t2 = file.numbers("xcr:DistortionCoeficients", text, 6).tolist()
    if value("Skew", "0"):
        hint = "Choose a distortion model without K+, align again."
        raise file.unsupported("xcr:Skew", "a skewed camera", hint)
    if model == _PLAIN or not any((k1, k2, k3, k4, t1, t2)):
        return RelativeLens(focal, aspect, offset, Brown())
    if model not in _BROWN:
        raise file.unsupported("xcr:DistortionModel", f"the lens {model}", _NO_DIVISION)
    # The program's t1 and t2 are OpenCV's p2 and p1.
    return RelativeLens(focal, aspect, offset, Brown(k1, k2, k3, k4, p1=t2, p2=t1))
