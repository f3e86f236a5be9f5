# SPDX-License-Identifier: GPL-3.0-or-later
"""Crop volumes of Tanks and Temples: a polygon swept along an axis (Open3D's selection volume)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import ParseError
from ...files import read_json

CLASS_NAME = "SelectionPolygonVolume"
VERSION = 1
_AGAIN = "Use the crop file that belongs to the data set."
_PLANES = {"X": (1, 2, 0), "Y": (0, 2, 1), "Z": (0, 1, 2)}
"""For each axis: the two coordinates of the polygon's plane, then the axis itself."""


@dataclass(frozen=True)
class PolygonVolume:
    """All points between two heights whose projection along an axis lies in a polygon."""

    polygon: np.ndarray
    """(k, 3) float64 corners in order, the last joined to the first; the coordinate along the axis
    is not used. The polygon may be concave; self-intersections follow the even-odd rule."""
    orthogonal_axis: str
    """``"X"``, ``"Y"`` or ``"Z"``."""
    axis_min: float
    axis_max: float

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return whether (n, 3) points lie inside, (n,) bool.

        The heights ``axis_min`` and ``axis_max`` are inside. A point on the polygon's border is on
        the side with larger coordinates, so that exactly one of two volumes that share an edge
        contains it. NaN is outside.
        """
        points = np.asarray(points, np.float64)
        u, v, w = _PLANES[self.orthogonal_axis]
        height = points[:, w]
        result = (height >= self.axis_min) & (height <= self.axis_max)
        candidates = np.flatnonzero(result)
        x, y = points[candidates, u], points[candidates, v]
        odd = np.zeros(len(candidates), bool)
        corners = self.polygon[:, (u, v)]
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if y0 == y1:
                continue
            crosses = (y0 > y) != (y1 > y)
            odd ^= crosses & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
        result[candidates] = odd
        return result

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper corner, (3,) each, of the axis-aligned box around it."""
        u, v, w = _PLANES[self.orthogonal_axis]
        low, high = np.empty(3), np.empty(3)
        for axis in (u, v):
            low[axis], high[axis] = self.polygon[:, axis].min(), self.polygon[:, axis].max()
        low[w], high[w] = self.axis_min, self.axis_max
        return low, high

    def to_json(self) -> dict[str, Any]:
        """Return the values of the file format."""
        return {
            "class_name": CLASS_NAME,
            "version_major": VERSION,
            "version_minor": 0,
            "axis_max": self.axis_max,
            "axis_min": self.axis_min,
            "orthogonal_axis": self.orthogonal_axis,
            "bounding_polygon": self.polygon.tolist(),
        }


def read_polygon_volume(path: Path) -> PolygonVolume:
    """Read a crop file.

    Raises
    ------
    ParseError
        States the entry: missing, not finite, an unknown axis or version, too few corners.
    """
    try:
        values = read_json(path, follow_links=True)
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read: {error.strerror}.", _AGAIN) from None
    if not isinstance(values, dict):
        raise ParseError(path, "top level", "an object was expected.", _AGAIN)
    if values.get("class_name", CLASS_NAME) != CLASS_NAME:
        raise ParseError(path, "class_name", f"is not {CLASS_NAME!r}.", _AGAIN)
    version = values.get("version_major", values.get("version", VERSION))
    if isinstance(version, bool) or version != VERSION:
        raise ParseError(path, "version_major", f"{str(version)[:20]} is not known.", _AGAIN)
    axis = values.get("orthogonal_axis")
    if not isinstance(axis, str) or axis.upper() not in _PLANES:
        raise ParseError(path, "orthogonal_axis", "X, Y or Z was expected.", _AGAIN)
    low, high = (_number(path, key, values.get(key)) for key in ("axis_min", "axis_max"))
    if not low < high:
        raise ParseError(path, "axis_min", f"{low:g} is not below axis_max {high:g}.", _AGAIN)
    rows = values.get("bounding_polygon")
    if not isinstance(rows, list) or len(rows) < 3:
        raise ParseError(path, "bounding_polygon", "at least 3 corners were expected.", _AGAIN)
    corners = []
    for i, row in enumerate(rows):
        place = f"bounding_polygon[{i}]"
        if not isinstance(row, list) or len(row) != 3:
            raise ParseError(path, place, "three numbers were expected.", _AGAIN)
        corners.append([_number(path, place, value) for value in row])
    return PolygonVolume(np.array(corners, np.float64), axis.upper(), low, high)


def _number(path: Path, place: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ParseError(path, place, "a number was expected.", _AGAIN)
    if not math.isfinite(value):
        raise ParseError(path, place, "the number is not finite.", _AGAIN)
    return float(value)
