# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes that Blender hands over to the worker: arrays in world coordinates, in double precision.

Needs numpy only.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ...array_file import read_arrays
from ...errors import ParseError
from ...files import write_bytes
from ..polygons import checked_polygons
from .mesh_reader import FileMesh

SUFFIX = ".npz"
MAX_BYTES = 4 * 2**30
_AGAIN = "Start it again from Blender."


def write_handed_over(path: Path, mesh: FileMesh) -> None:
    """Write a mesh in the world frame of the job's input.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    arrays = {} if mesh.corner_uvs is None else {"corner_uvs": np.asarray(mesh.corner_uvs)}
    if mesh.polygons is not None:
        arrays |= {"polygons": mesh.polygons.of_faces, "loops": mesh.polygons.loops}
        arrays |= {"is_new": np.array(mesh.is_new)}
    stream = io.BytesIO()
    np.savez(stream, frame=np.array("world"), vertices=mesh.vertices, faces=mesh.faces, **arrays)
    write_bytes(path, stream.getvalue())


def read_handed_over(path: Path) -> FileMesh:
    """Read a file of :func:`write_handed_over`.

    Raises
    ------
    ParseError
        It is none, or its mesh has no faces, values that are not finite, or indices out of range.
    """
    if not path.is_file():
        raise ParseError(path, "whole file", "the file does not exist.", _AGAIN)
    names = ("frame", "vertices", "faces")
    optional = ("corner_uvs", "polygons", "loops", "is_new")
    arrays = read_arrays(path, names, optional=optional, most_bytes=MAX_BYTES, hint=_AGAIN)
    try:
        if str(arrays["frame"]) != "world":
            raise ValueError("not in world coordinates")
        vertices = np.asarray(arrays["vertices"], np.float64)
        faces = arrays["faces"]
        uvs = arrays["corner_uvs"].astype(np.float64) if "corner_uvs" in arrays else None
        if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.dtype.kind not in "iu":
            raise ValueError("not lists of triples")
        if uvs is not None and uvs.shape != (len(faces), 3, 2):
            raise ValueError("UVs are not those of the faces")
        polygons = None
        if "polygons" in arrays and "loops" in arrays:
            polygons = checked_polygons(arrays["polygons"], arrays["loops"], len(faces))
        is_new = polygons is not None and bool(arrays.get("is_new", np.array(False)).any())
    except (ValueError, TypeError) as error:
        raise ParseError(
            path, "whole file", f"not a mesh handed over by Blender ({error}).", _AGAIN
        ) from None
    if len(faces) == 0:
        raise ParseError(path, "faces", "there are none.", "Choose a mesh with faces.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ParseError(path, "faces", "an index is out of range.", _AGAIN)
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise ParseError(
            path, f"vertex {int(bad[0])}", f"is not finite (as are {len(bad)} in all).",
            "Delete these vertices, or undo what made them.",
        )  # fmt: skip
    return FileMesh(vertices, faces.astype(np.int64), uvs, polygons, is_new)
