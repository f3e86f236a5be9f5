# SPDX-License-Identifier: GPL-3.0-or-later
"""Read "Internal/External camera parameters" (CSV) of RealityScan and RealityCapture.

A row holds the position, heading, pitch and roll in degrees, the focal length in millimetres of a
film 36 mm wide, the principal point in shares of the photo's long side from its middle, and Brown's
coefficients. Heading is clockwise from +y about +z; with all angles 0 the camera looks down and the
photo's top is +y. The file states no photo sizes: lenses are completed when the photos are known.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np

from .... import limits
from ....errors import ParseError
from ....regular_files import read_bounded
from ..source_model import Brown, RelativeLens, SourceModel
from .photo_list import PhotoList, relative_names
from .values import AGAIN, number, pose_at, unsupported

KIND = "RealityScan CSV"

FILM_WIDTH_MM = 36.0
_FIRST_COLUMN = "#name"
_MAX_BYTES = 64 * 1024 * 1024
"""A row takes about 250 bytes: 64 MB are more photos than the limit."""
_SYNONYMS = {
    "yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py", "z": "alt",
}  # fmt: skip
"""Later versions of the program call the same columns otherwise."""
_NEEDED = ("x", "y", "alt", "heading", "pitch", "roll", "f")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_OPENGL_FROM_COLMAP = np.diag([1.0, -1.0, -1.0])
_CHOOSE = 'Export "Internal/External camera parameters" as CSV.'


def is_csv_of_cameras(path: Path) -> bool:
    """Whether a CSV file begins with the column of photo names that the program writes."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    try:
        with path.open("rb") as stream:
            start = stream.read(256)
    except OSError:
        return False
    return start.removeprefix(b"\xef\xbb\xbf").lstrip().lower().startswith(b"#name")


def read_csv(path: Path) -> SourceModel:
    """Read the cameras of a CSV file; it holds no points.

    Raises
    ------
    ParseError
        Names the line and the column.
    DatasetError
        No photo is usable.
    """
    data = read_bounded(path, _MAX_BYTES, follow_links=True)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ParseError(
            path, f"byte {error.start}", "not UTF-8 text.", "Save it as UTF-8."
        ) from None
    if "\0" in text:
        raise ParseError(path, "whole file", "not text.", _CHOOSE)
    rows = _rows(path, text)
    header = _header(path, rows[0][1] if rows else [])
    photos = PhotoList(path)
    photos.check_count("rows", len(rows) - 1)
    names = relative_names(row[header[_FIRST_COLUMN]] for _, row in rows[1:] if row)
    for line, row in rows[1:]:
        if len(row) < len(header):
            raise ParseError(
                path, f"line {line}", f"{len(row)} columns instead of {len(header)}.", AGAIN
            )

        def value(column: str, line: int = line, row: list[str] = row) -> float:
            if column not in header:
                return 0.0
            return number(path, f"line {line}, {column}", row[header[column]])

        name = names[row[header[_FIRST_COLUMN]]]
        world_from_camera = _world_from_opengl(
            *(math.radians(value(angle)) for angle in ("heading", "pitch", "roll"))
        )
        center = np.array([value("x"), value("y"), value("alt")])
        pose = pose_at((world_from_camera @ _OPENGL_FROM_COLMAP).T, center)
        focal = value("f") / FILM_WIDTH_MM
        if focal <= 0:
            raise ParseError(path, f"line {line}, f", "the focal length is not positive.", AGAIN)
        # The program's t1 and t2 are OpenCV's p2 and p1.
        brown = Brown(*(value(k) for k in ("k1", "k2", "k3", "k4", "t2", "t1")))
        lens = RelativeLens(focal, 1.0, (value("px"), value("py")), brown)
        photos.add(name, None, pose, relative=lens)
    usable = photos.finished()
    return SourceModel(KIND, usable, warnings=tuple(photos.warnings), facts={"rows": len(rows) - 1})


def _rows(path: Path, text: str) -> list[tuple[int, list[str]]]:
    """Return the rows that are not empty, with their lines."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows = []
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append((reader.line_num, [cell.strip() for cell in row]))
            if len(rows) > limits.MAX_IMAGES + 1:
                raise ParseError(path, "rows", "there are too many.", "Split the project.")
    except csv.Error as error:
        raise ParseError(path, f"line {reader.line_num}", f"not CSV: {error}.", AGAIN) from None
    return rows


def _header(path: Path, cells: list[str]) -> dict[str, int]:
    """Return the column of each name."""
    names = [cell.lower() for cell in cells]
    names = [_SYNONYMS.get(name, name) for name in names]
    if not names or names[0] != _FIRST_COLUMN:
        raise ParseError(path, "line 1", "the column #name was expected first.", _CHOOSE)
    if len(set(names)) < len(names):
        raise ParseError(path, "line 1", "a column is there twice.", _CHOOSE)
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise ParseError(path, "line 1", f"columns are missing: {', '.join(missing)}.", _CHOOSE)
    known = {_FIRST_COLUMN, *_NEEDED, *_OPTIONAL}
    for name in names:
        if name not in known and name[:1] in ("k", "t", "s") and name[1:2].isdigit():
            raise unsupported(path, "line 1", f"lens coefficient {name}", _CHOOSE)
    return {name: column for column, name in enumerate(names)}


def _world_from_opengl(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Return the (3, 3) rotation of a camera with OpenGL axes (x right, y up, z back)."""
    about_z = np.array([
        [math.cos(heading), math.sin(heading), 0.0],
        [-math.sin(heading), math.cos(heading), 0.0],
        [0.0, 0.0, 1.0],
    ])  # fmt: skip
    about_x = np.array([
        [1.0, 0.0, 0.0],
        [0.0, math.cos(pitch), -math.sin(pitch)],
        [0.0, math.sin(pitch), math.cos(pitch)],
    ])  # fmt: skip
    about_y = np.array([
        [math.cos(roll), 0.0, math.sin(roll)],
        [0.0, 1.0, 0.0],
        [-math.sin(roll), 0.0, math.cos(roll)],
    ])  # fmt: skip
    return about_z @ about_x @ about_y
