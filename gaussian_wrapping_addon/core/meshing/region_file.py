# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions on disk, in world coordinates: bounding-volume JSON, version 1.

See docs/method.md, section 7.3.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from .. import limits
from ..errors import MeshingError, ParseError
from ..files import read_json, write_json
from .convex_region import Region

_logger = logging.getLogger(__name__)

CLASS_NAME = "GaussianWrappingBoundingVolume"
VERSION = 1
MAX_COORDINATE = 1e12
"""Beyond this, float64 leaves less than a tenth of a millimetre."""


def read_region(path: Path) -> Region:
    """Read a region file.

    Raises
    ------
    ParseError
        Names the file, the entry and what to do; nothing is guessed.
    """
    try:
        values = read_json(path)
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read ({error.strerror}).") from None
    return parse_region(values, path)


def parse_region(values: Any, path: Path) -> Region:
    """Build a region from JSON values; ``path`` is only named in errors.

    ``hull_simplices`` is not read: the hull is recomputed, so that it cannot disagree.

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
    name = _clean_name(values.get("blender_object_name")) or _clean_name(path.stem) or "region"
    vertices = _parse_vertices(values.get("vertices"), path, again)
    try:
        region = Region(name, vertices)
    except MeshingError as error:
        raise ParseError(path, "vertices", error.message, error.hint) from None
    used = len(np.unique(region.simplices))
    if used < len(vertices):
        _logger.warning(
            "%s: %d of %d corners lie inside the convex hull; the hull is used",
            path.name, len(vertices) - used, len(vertices),
        )  # fmt: skip
    return region


def _clean_name(name: Any) -> str:
    """Return a name that fits into any text file and its bound in bytes; empty without one.

    JSON may hold half of a surrogate pair, which no encoding writes; it becomes a question mark.
    NUL ends names in Blender and in file systems, so it goes.
    """
    text = name.replace("\0", "") if isinstance(name, str) else ""
    if not text.strip():
        return ""
    encoded = text.encode(errors="replace")
    return encoded[: limits.MAX_NAME_BYTES].decode(errors="ignore")


def _parse_vertices(rows: Any, path: Path, hint: str) -> np.ndarray:
    if not isinstance(rows, list):
        raise ParseError(path, "vertices", "is missing or not a list.", hint)
    if len(rows) > limits.MAX_REGION_VERTICES:
        raise ParseError(
            path,
            "vertices",
            f"holds {len(rows)} corners; {limits.MAX_REGION_VERTICES} is the most.",
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


def write_region(path: Path, region: Region) -> None:
    """Write a region file atomically; the region must be in world coordinates."""
    write_json(
        path,
        {
            "class_name": CLASS_NAME,
            "version": VERSION,
            "blender_object_name": region.name,
            "vertices": region.vertices.tolist(),
            "hull_simplices": region.simplices.tolist(),
        },
    )
