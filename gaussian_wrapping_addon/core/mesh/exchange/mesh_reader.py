# SPDX-License-Identifier: GPL-3.0-or-later
"""Read triangle meshes with their UVs from common file formats."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...dataset.photos.image_formats import forbid_ghostscript
from ...errors import ParseError, WorkerError
from ..polygons import Polygons

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".stl", ".off")
_AGAIN = "Export the file again."


@dataclass(frozen=True)
class FileMesh:
    """A triangle mesh as its file has it."""

    vertices: np.ndarray
    """(v, 3) float64, coordinates of the file."""
    faces: np.ndarray
    """(f, 3) int64."""
    corner_uvs: np.ndarray | None = None
    """(f, 3, 2) float64, v upwards, not checked; ``None`` if a part of the mesh has no UVs."""
    polygons: Polygons | None = None
    """What its triangles are parts of; ``None`` if that is not known."""
    is_new: bool = False
    """Whether it was made for a bake, and Blender is to show it as an object of its own."""


def read_mesh_file(path: Path) -> FileMesh:
    """Read a triangle mesh with trimesh, in the coordinates of the file.

    Node transforms of a GLB are applied; its axes are kept (Y up). The parts of a file become one
    mesh; parts share no vertices, and vertices with several UVs may be repeated.

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
    named = path.suffix.lower() in (".obj", ".ply")  # textures of other files, which are not read
    options: dict[str, Any] = {"skip_materials": True} if named else {}
    try:
        loaded: Any = trimesh.load(path, process=False, **options)
        # Joined here: trimesh would change the UVs of parts with different materials.
        parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        mesh = _joined([part for part in parts if isinstance(part, trimesh.Trimesh)])
    except Exception as error:  # a broken file can make the reader raise anything
        raise ParseError(
            path, "whole file", f"cannot be read as a mesh ({error}); it may be truncated.", _AGAIN
        ) from None
    if len(mesh.faces) == 0:
        raise ParseError(path, "faces", "there are none, or the file is truncated.", _AGAIN)
    faces, count = mesh.faces, len(mesh.vertices)
    if faces.min() < 0 or faces.max() >= count:
        bad = int(np.flatnonzero(((faces < 0) | (faces >= count)).any(1))[0])
        raise ParseError(path, f"face {bad}", "refers to a vertex that does not exist.", _AGAIN)
    not_finite = np.flatnonzero(~np.isfinite(mesh.vertices).all(1))
    if len(not_finite):
        place = f"vertex {int(not_finite[0])}"
        raise ParseError(path, place, f"is not finite (as are {len(not_finite)} in all).", _AGAIN)
    return mesh


def _joined(parts: list[Any]) -> FileMesh:
    """Join the parts of a file; UVs are kept if every part has them."""
    vertices, faces, corner_uvs, base = [], [], [], 0
    for part in parts:
        part_vertices = np.asarray(part.vertices, np.float64).reshape(-1, 3)
        part_faces = np.asarray(part.faces, np.int64).reshape(-1, 3)
        uvs = getattr(part.visual, "uv", None)
        if uvs is not None and np.shape(uvs) == (len(part_vertices), 2) and len(part_faces):
            corner_uvs.append(np.asarray(uvs, np.float64)[part_faces])
        vertices.append(part_vertices)
        faces.append(part_faces + base)
        base += len(part_vertices)
    if not parts:
        return FileMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    filled = sum(len(part) > 0 for part in faces)
    return FileMesh(
        np.concatenate(vertices),
        np.concatenate(faces),
        np.concatenate(corner_uvs) if corner_uvs and len(corner_uvs) == filled else None,
    )
