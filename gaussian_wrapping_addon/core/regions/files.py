# SPDX-License-Identifier: GPL-3.0-or-later
"""Region files: JSON and .rsbox of RealityScan."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np

from .. import limits
from ..errors import DatasetError, MeshingError, ParseError, UsageError
from ..files import read_bounded, read_json, write_bytes, write_json
from ..names import printable_name
from .box import CUBE_CORNERS, CUBE_TRIANGLES, box_matrix, check_volume

# -- Reconstruction regions of RealityScan and RealityCapture: ``.rsbox`` and ``.rcbox`` files ----
#
# Small XML files, read and written as docs/file-formats.md describes them. The box of a file in a
# frame that is not Euclidean, or with a residual transform, is refused: where it lies is not
# known.


SUFFIXES: Final = (".rsbox", ".rcbox")
"""Of RealityScan, and of RealityCapture before it."""
MAX_BYTES: Final = 64 * 1024
"""Files of the programs have about 600 bytes; what is larger holds something else."""
MAX_COORDINATE: Final = 1e12
"""Beyond this, float64 leaves less than a tenth of a millimetre."""
GIMBAL_SINE: Final = 1.0 - 1e-12
"""Of the middle angle; beyond it, the two others turn about the same axis, and one is set to 0."""
RESIDUAL_TOLERANCE: Final = 1e-9
"""Of a residual transform's numbers from those of the identity; the programs write whole ones."""
_ROOT: Final = "ReconstructionRegion"
_AGAIN: Final = "Export the reconstruction region again."
_IDENTITY: Final = {
    "R": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), "t": (0.0,) * 3, "s": (1.0,),
}  # fmt: skip


def is_rsbox(path: Path) -> bool:
    """Return whether a file's name is that of a reconstruction region."""
    return path.suffix.lower() in SUFFIXES


def read_rsbox(path: Path) -> np.ndarray:
    """Read a reconstruction region: (8, 3) corners in the coordinates of its project.

    They are in the order of :data:`~.box.CUBE_CORNERS` along the box's own axes.

    Raises
    ------
    OSError
        The file cannot be read.
    ParseError
        Names the file, the entry and what to do; no values are guessed.
    """
    root = _root(path, read_bounded(path, MAX_BYTES, follow_links=True))
    _check_frame(path, root)
    size = _numbers(path, root, "widthHeightDepth", 3)
    if min(size) <= 0.0:
        raise ParseError(path, "widthHeightDepth", "a side is not above 0.", _AGAIN)
    center = _numbers(path, _child(path, root, "CentreEuclid"), "centre", 3)
    rotation = rotation_of(*_numbers(path, root, "yawPitchRoll", 3))
    return np.asarray(center + (CUBE_CORNERS * (0.5 * np.array(size))) @ rotation.T)


def write_rsbox(path: Path, vertices: np.ndarray, name: str = "region") -> None:
    """Write a box, (8, 3) world corners in any order, as a reconstruction region, atomically.

    Raises
    ------
    UsageError
        The body is no box, which is all that the format has.
    """
    matrix = box_matrix(np.asarray(vertices, np.float64))
    if matrix is None:
        text = f"Region {name!r} is no box, and {path.suffix} files hold only boxes."
        raise UsageError(text, "Export it as .json.")
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)  # (3,), half of each side
    root = ElementTree.Element(
        _ROOT, globalCoordinateSystem="NONE", globalCoordinateSystemWkt="NONE",
        globalCoordinateSystemName="NONE", isGeoreferenced="0", isLatLon="0",
        yawPitchRoll=_text(angles_of(matrix[:3, :3] / lengths)),
        widthHeightDepth=_text(2.0 * lengths),
    )  # fmt: skip
    ElementTree.SubElement(root, "Header", magic="5395016", version="2")
    centre = ElementTree.SubElement(ElementTree.SubElement(root, "CentreEuclid"), "centre")
    centre.text = _text(matrix[:3, 3])
    ElementTree.SubElement(root, "Residual", {k: _text(v) for k, v in _IDENTITY.items()})
    ElementTree.indent(root)
    write_bytes(path, ElementTree.tostring(root) + b"\n")


def rotation_of(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Return the (3, 3) rotation from a box's axes to the world, of three angles in degrees.

    A box is turned about x by -pitch, then about y by -yaw, then about z by -roll.
    """
    turns = [math.radians(-angle) for angle in (pitch, yaw, roll)]
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(turn), math.sin(turn)) for turn in turns)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ about_y @ about_x)


def angles_of(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return yaw, pitch and roll, degrees, of a (3, 3) rotation; see :func:`rotation_of`."""
    sine = float(-rotation[2, 0])
    about_y = math.asin(min(max(sine, -1.0), 1.0))
    if abs(sine) < GIMBAL_SINE:
        about_x = math.atan2(rotation[2, 1], rotation[2, 2])
        about_z = math.atan2(rotation[1, 0], rotation[0, 0])
    else:
        about_x, about_z = 0.0, math.atan2(-rotation[0, 1], rotation[1, 1])
    return math.degrees(-about_y), math.degrees(-about_x), math.degrees(-about_z)


def _root(path: Path, data: bytes) -> ElementTree.Element:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ParseError(path, f"byte {error.start}", "not UTF-8 text.", _AGAIN) from None
    # Entities could grow without bound; regions have neither them nor a document type.
    for word in ("DOCTYPE", "ENTITY"):
        if f"<!{word}" in text:
            raise ParseError(path, "whole file", f"{word} is not allowed.", _AGAIN)
    try:
        root = ElementTree.fromstring(text)  # noqa: S314 - small, without entities
    except ElementTree.ParseError as error:
        raise ParseError(path, f"line {error.position[0]}", "not XML.", _AGAIN) from None
    except (ValueError, LookupError):  # NUL characters, an encoding that does not exist
        raise ParseError(path, "whole file", "not XML.", _AGAIN) from None
    if root.tag != _ROOT:
        text = f"is {root.tag[:40]!r}, not {_ROOT!r}."
        raise ParseError(path, "root", text, "Choose a region file.")
    return root


def _check_frame(path: Path, root: ElementTree.Element) -> None:
    name = root.get("globalCoordinateSystemName", "NONE")
    local = name == "NONE" or name.startswith("local:")
    if root.get("isLatLon", "0") != "0" or not local:
        raise ParseError(
            path, "globalCoordinateSystemName", f"{name[:60]!r} is not a local Euclidean frame.",
            "Set the project's output coordinate system to local Euclidean, and export the region "
            "and the cameras again.",
        )  # fmt: skip
    residual = root.find("Residual")
    if residual is None:
        return
    for entry, wanted in _IDENTITY.items():
        if entry in residual.attrib:
            found = _numbers(path, residual, entry, len(wanted))
            if max(abs(a - b) for a, b in zip(found, wanted, strict=True)) > RESIDUAL_TOLERANCE:
                raise ParseError(
                    path, f"Residual {entry}", "is not that of the identity.",
                    "Draw the region again in Blender, or give a region JSON.",
                )  # fmt: skip


def _child(path: Path, element: ElementTree.Element, name: str) -> ElementTree.Element:
    found = element.find(name)
    if found is None:
        raise ParseError(path, name, "is missing.", _AGAIN)
    return found


def _numbers(path: Path, element: ElementTree.Element, name: str, count: int) -> list[float]:
    """Return the numbers of an attribute, or of a child element of that name."""
    text = element.get(name)
    if text is None:
        text = _child(path, element, name).text or ""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(abs(number) <= MAX_COORDINATE for number in numbers):
        words = f"{count} finite numbers" if count > 1 else "a finite number"
        raise ParseError(path, name, f"is not {words}.", _AGAIN)
    return numbers


def _text(numbers: Any) -> str:
    # Adding 0 leaves no minus zero.
    return " ".join(f"{float(number) + 0.0:.15g}" for number in numbers)


# -- Region files (docs/file-formats.md): bounding-volume JSON, version 1, and those of RealityScan


CLASS_NAME = "GaussianWrappingBoundingVolume"
VERSION = 1
SHAPE_ENTRIES = ("class_name", "version", "vertices")
"""Of a region file's values, those that say where it is."""


@dataclass(frozen=True)
class RegionFile:
    """Contents of a region file; the region is the convex hull of its vertices."""

    name: str  # Not empty, encodable, within :data:`limits.MAX_NAME_BYTES`
    vertices: np.ndarray  # (n, 3) float64, world frame, finite, enclosing a volume


def read_region_file(path: Path) -> RegionFile:
    """Read and validate a region file.

    Raises
    ------
    DatasetError
        There is no file, or it cannot be read.
    ParseError
        Names the file, the entry and what to do; no values are guessed.
    """
    return parse_region_file(read_region_body(path), path)


def read_region_body(path: Path) -> Any:
    """Read the JSON values of a region file; :func:`parse_region_file` validates them.

    A reconstruction region of RealityScan becomes the values that its JSON would have.

    Raises
    ------
    DatasetError
        There is no file, or it cannot be read.
    """
    if path.is_dir():
        raise DatasetError(f"{path} is a folder, not a region file.", "Give a file in it.")
    if not path.is_file():
        raise DatasetError(f"Region file {path} does not exist.", "Check the path.")
    try:
        if is_rsbox(path):
            return region_to_json(path.stem, read_rsbox(path), CUBE_TRIANGLES)
        return read_json(path, follow_links=True)
    except OSError as error:
        raise DatasetError(
            f"Region file {path} cannot be read: {error.strerror}.", "Check its permissions."
        ) from None


def parse_region_file(values: Any, path: Path) -> RegionFile:
    """Validate JSON values; ``path`` is used in errors, and as the name of an unnamed region.

    ``hull_simplices`` is not read: users of the hull compute it, so that the two cannot disagree.

    Raises
    ------
    ParseError
    """
    again = "Export the region again."
    if not isinstance(values, dict):
        raise ParseError(path, "top level", "is not an object.", again)
    if values.get("class_name") != CLASS_NAME:
        raise ParseError(path, "class_name", f"is not {CLASS_NAME!r}.", "Choose a region file.")
    version = values.get("version")
    if isinstance(version, bool) or version != VERSION:
        text = f"{str(version)[:20]!r} is not known; {VERSION} is."
        raise ParseError(path, "version", text, again)
    name = printable_name(values.get("blender_object_name")) or printable_name(path.stem)
    name = name or "region"
    vertices = _parse_vertices(values.get("vertices"), path, again)
    try:
        check_volume(vertices, name)
    except MeshingError as error:
        raise ParseError(path, "vertices", error.message, error.hint) from None
    return RegionFile(name, vertices)


def _parse_vertices(rows: Any, path: Path, hint: str) -> np.ndarray:
    if not isinstance(rows, list):
        raise ParseError(path, "vertices", "is missing or not a list.", hint)
    if len(rows) > limits.MAX_REGION_VERTICES:
        text = f"holds {len(rows)} corners; the limit is {limits.MAX_REGION_VERTICES}."
        raise ParseError(path, "vertices", text, "Use a simpler body, such as a box.")
    for index, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != 3 or not all(map(_is_coordinate, row)):
            raise ParseError(path, f"vertices[{index}]", "is not three finite numbers.", hint)
    return np.array(rows, np.float64).reshape(-1, 3)


def _is_coordinate(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= MAX_COORDINATE  # false for NaN as well


def region_to_json(
    name: str, vertices: np.ndarray, simplices: Iterable[Iterable[int]] | None = None
) -> dict[str, Any]:
    """Return the JSON values of a region file: (n, 3) world vertices, triangles of the hull."""
    return {
        "class_name": CLASS_NAME, "version": VERSION, "blender_object_name": name,
        "vertices": np.asarray(vertices, np.float64).tolist(),
        "hull_simplices": None if simplices is None else [list(map(int, s)) for s in simplices],
    }  # fmt: skip


def write_region_file(
    path: Path, name: str, vertices: np.ndarray, simplices: Iterable[Iterable[int]] | None = None
) -> None:
    """Write a region file atomically; the parameters are those of :func:`region_to_json`.

    The suffix decides the format: JSON, or the box of a reconstruction region.

    Raises
    ------
    UsageError
        A body that is no box cannot be a reconstruction region.
    """
    if is_rsbox(path):
        write_rsbox(path, np.asarray(vertices, np.float64), name)
    else:
        write_json(path, region_to_json(name, vertices, simplices))
