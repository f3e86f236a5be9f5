# SPDX-License-Identifier: GPL-3.0-or-later
"""Read meshes and point clouds for evaluation from common file formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...dataset.photos.image_formats import forbid_ghostscript
from ...dataset.readers.point_file import read_point_ply
from ...errors import ParseError, WorkerError
from ...ply.header import read_ply_header

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".stl", ".off")
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
    """Read a triangle mesh with trimesh, in the coordinates of the file.

    Node transforms of a GLB are applied; its axes are kept (Y up).

    Returns
    -------
    vertices : (v, 3) float64
    faces : (f, 3) int64

    Raises
    ------
    ParseError
        Not a mesh file, truncated, without faces, with values that are not finite, or with vertex
        indices out of range.
    WorkerError
        The worker's Python lacks trimesh.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ParseError(
            path, "file name", "not a known mesh format.", f"Use one of {', '.join(MESH_SUFFIXES)}."
        )
    if not path.is_file():
        raise ParseError(path, "whole file", "the file does not exist.", "Check the path.")
    try:
        import trimesh
    except ImportError:
        raise WorkerError(
            "The worker's Python lacks trimesh, which reads meshes.",
            "pip install -r requirements-worker.txt there.",
        ) from None
    forbid_ghostscript()  # a GLB holds its textures, which trimesh opens in any format
    textured = path.suffix.lower() in (".obj", ".ply")
    options: dict[str, Any] = {"skip_materials": True} if textured else {}
    try:
        loaded: Any = trimesh.load(path, process=False, force="mesh", **options)
        vertices = np.asarray(loaded.vertices, np.float64).reshape(-1, 3)
        faces = np.asarray(loaded.faces, np.int64).reshape(-1, 3)
    except Exception as error:  # a broken file can make the reader raise anything
        raise ParseError(
            path, "whole file", f"cannot be read as a mesh ({error}); it may be truncated.", _AGAIN
        ) from None
    if len(faces) == 0:
        raise ParseError(path, "faces", "there are none, or the file is truncated.", _AGAIN)
    if faces.min() < 0 or faces.max() >= len(vertices):
        bad = int(np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(1))[0])
        raise ParseError(path, f"face {bad}", "refers to a vertex that does not exist.", _AGAIN)
    _require_finite(path, vertices)
    return vertices, faces


def _require_finite(path: Path, points: np.ndarray) -> None:
    bad = np.flatnonzero(~np.isfinite(points).all(1))
    if len(bad):
        raise ParseError(
            path, f"vertex {int(bad[0])}", f"is not finite (as are {len(bad)} in all).", _AGAIN
        )


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
