# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write region files (docs/file-formats.md): bounding-volume JSON, version 1, and the
reconstruction regions of RealityScan.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import limits
from ..errors import DatasetError, MeshingError, ParseError
from ..files import read_json, write_json
from ..names import printable_name
from .box import CUBE_TRIANGLES
from .rsbox import is_rsbox, read_rsbox, write_rsbox
from .volume import check_volume

CLASS_NAME = "GaussianWrappingBoundingVolume"
VERSION = 1
MAX_COORDINATE = 1e12
"""Beyond this, float64 leaves less than a tenth of a millimetre."""


@dataclass(frozen=True)
class RegionFile:
    """Contents of a region file; the region is the convex hull of its vertices."""

    name: str
    """Not empty, encodable, within :data:`limits.MAX_NAME_BYTES`."""
    vertices: np.ndarray
    """(n, 3) float64, world frame, finite, enclosing a volume."""


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
    if is_rsbox(path):
        return region_to_json(path.stem, read_rsbox(path), CUBE_TRIANGLES)
    try:
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
        raise ParseError(
            path, "version", f"{str(version)[:20]!r} is not known; {VERSION} is.", again
        )
    name = printable_name(values.get("blender_object_name")) or printable_name(path.stem)
    vertices = _parse_vertices(values.get("vertices"), path, again)
    try:
        check_volume(vertices, name or "region")
    except MeshingError as error:
        raise ParseError(path, "vertices", error.message, error.hint) from None
    return RegionFile(name or "region", vertices)


def _parse_vertices(rows: Any, path: Path, hint: str) -> np.ndarray:
    if not isinstance(rows, list):
        raise ParseError(path, "vertices", "is missing or not a list.", hint)
    if len(rows) > limits.MAX_REGION_VERTICES:
        raise ParseError(
            path,
            "vertices",
            f"holds {len(rows)} corners; the limit is {limits.MAX_REGION_VERTICES}.",
            "Use a simpler body, such as a box.",
        )
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
    """Return the JSON values of a region file.

    Parameters
    ----------
    vertices : (n, 3) float64
        World frame.
    simplices : iterable of index triples, optional
        Triangles of the hull.
    """
    return {
        "class_name": CLASS_NAME,
        "version": VERSION,
        "blender_object_name": name,
        "vertices": np.asarray(vertices, np.float64).tolist(),
        "hull_simplices": None if simplices is None else [list(map(int, s)) for s in simplices],
    }


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
