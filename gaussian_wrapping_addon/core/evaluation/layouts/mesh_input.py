# SPDX-License-Identifier: GPL-3.0-or-later
"""Read meshes and point clouds for evaluation from common file formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...dataset.readers.point_file import read_point_ply
from ...errors import ParseError
from ...mesh.exchange.mesh_reader import read_mesh_file
from ...ply.header import read_ply_header

_AGAIN = "Export the file again."


def is_cloud(path: Path) -> bool:
    """Return whether a file is a PLY without faces; other formats count as meshes.

    Raises
    ------
    ParseError
        The header of the PLY is invalid.
    """
    return path.suffix.lower() == ".ply" and not read_ply_header(path, _AGAIN).count("face")


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return (v, 3) float64 vertices and (f, 3) int64 faces, in the coordinates of the file.

    Raises
    ------
    ParseError, WorkerError
        As :func:`~.mesh_reader.read_mesh_file`.
    """
    mesh = read_mesh_file(path)
    return mesh.vertices, mesh.faces


def read_cloud(path: Path) -> np.ndarray:
    """Read the points of a PLY, (n, 3) float64.

    Raises
    ------
    ParseError
        Not a PLY, truncated, empty, or with points that are not finite.
    """
    announced = read_ply_header(path, _AGAIN).count("vertex")
    points, _ = read_point_ply(path)
    if announced == 0:
        raise ParseError(path, "header", "the cloud is empty.", _AGAIN)
    if len(points) < announced:
        raise ParseError(
            path, "vertices", f"{announced - len(points)} of {announced} are not finite.", _AGAIN
        )
    return points
