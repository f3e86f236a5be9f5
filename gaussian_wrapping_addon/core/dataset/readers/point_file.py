# SPDX-License-Identifier: GPL-3.0-or-later
"""Bounded reader of a point cloud in PLY format (the ``ply_file_path`` of transforms.json)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ... import limits
from ...errors import ParseError
from ...ply.header import PlyHeader, read_ply_header
from ...ply.table import read_vertices

_AGAIN = "Export the points again as PLY with x, y, z."


def read_point_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions and colours of a PLY's vertices (ASCII or binary).

    Returns
    -------
    points : (n, 3) float64
    colors : (n, 3) uint8
        Grey where the file has none.

    Raises
    ------
    ParseError
        With the place in the file.
    """
    header = read_ply_header(path, _AGAIN)
    rows = read_vertices(path, header, _AGAIN, limits.MAX_POINTS)
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise ParseError(path, "header", "x, y, z are missing.", _AGAIN)
    if header.encoding == "ascii":
        rows = _as_declared(header, rows)
    points = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], 1)
    colors = np.full((len(points), 3), 128, np.uint8)
    if all(name in names for name in ("red", "green", "blue")):
        values = np.stack([rows[name] for name in ("red", "green", "blue")], 1)
        if values.dtype.kind == "f":
            values = np.nan_to_num(values) * 255.0
        colors = values.clip(0, 255).astype(np.uint8)
    good = np.isfinite(points).all(1)
    return points[good], colors[good]


def _as_declared(header: PlyHeader, table: np.ndarray) -> np.ndarray:
    """Return the rows of an ASCII file in the types of its header.

    Colours may be written with a fraction; the declared type decides.
    """
    rows = np.zeros(len(table), np.dtype(list(header.elements[0].properties)))
    for name in rows.dtype.names or ():
        column = table[name]
        whole = rows.dtype[name].kind != "f"
        rows[name] = np.nan_to_num(column).clip(-1e9, 1e9) if whole else column
    return rows
