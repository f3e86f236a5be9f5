# SPDX-License-Identifier: GPL-3.0-or-later
"""Polygons that were handed over as triangles: their file beside a bake, and how they are joined.

Needs numpy only.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..array_file import read_arrays
from ..errors import ParseError
from ..files import write_bytes

POLYGONS_FILE = "polygons.npz"
MAX_BYTES = 4 * 2**30
SAME_UV = 1e-6
"""UVs of one corner in two triangles that differ by less are the same."""
_HINT = "Bake the photos again."


@dataclass(frozen=True)
class Polygons:
    """How triangles are parts of polygons."""

    of_faces: np.ndarray
    """(f,) int64 polygon of each triangle."""
    loops: np.ndarray
    """(f, 3) int64 loop at each corner. The loops of a polygon have numbers of their own, which
    ascend counter-clockwise."""


@dataclass(frozen=True)
class JoinedMesh:
    """Polygons as Blender holds them."""

    corners: np.ndarray
    """(c,) int64 vertices, polygon after polygon."""
    starts: np.ndarray
    """(p,) int64 first corner of each polygon."""
    uvs: np.ndarray
    """(c, 2) float32."""


def write_polygons(path: Path, polygons: Polygons) -> None:
    """Write the polygons of a mesh beside it.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    stream = io.BytesIO()
    np.savez(stream, polygons=polygons.of_faces, loops=polygons.loops)
    write_bytes(path, stream.getvalue())


def read_polygons(path: Path, faces: int) -> Polygons:
    """Read a file of :func:`write_polygons`.

    Parameters
    ----------
    path : Path
    faces : int
        Triangles of the mesh.

    Raises
    ------
    ParseError
        It is none, or of another mesh.
    """
    arrays = read_arrays(path, ("polygons", "loops"), most_bytes=MAX_BYTES, hint=_HINT)
    try:
        return checked_polygons(arrays["polygons"], arrays["loops"], faces)
    except ValueError as error:
        raise ParseError(path, "whole file", f"not of this mesh ({error}).", _HINT) from None


def checked_polygons(of_faces: np.ndarray, loops: np.ndarray, faces: int) -> Polygons:
    """Return polygons from arrays of a file.

    Raises
    ------
    ValueError
        Shapes, types or numbers are not those of this many triangles.
    """
    for name, values, shape in (("polygons", of_faces, (faces,)), ("loops", loops, (faces, 3))):
        if values.shape != shape or values.dtype.kind not in "iu":
            raise ValueError(f"{name} are not integers of shape {shape}")
        # A triangle adds a polygon at most, and three loops.
        if faces and not (values.min() >= 0 and values.max() < 3 * faces):
            raise ValueError(f"{name} are out of range")
    return Polygons(of_faces.astype(np.int64), loops.astype(np.int64))


def join_triangles(faces: np.ndarray, corner_uvs: np.ndarray, polygons: Polygons) -> JoinedMesh:
    """Join triangles to the polygons that they were cut from.

    Polygons whose triangles disagree stay triangles: where a seam of the UVs cuts them, or where
    vertices were welded to one. Triangles with a vertex twice are left out.

    Parameters
    ----------
    faces : (f, 3) int
        Indices within range.
    corner_uvs : (f, 3, 2) float
    polygons : Polygons
        Of these triangles.
    """
    loops, of_faces = polygons.loops, polygons.of_faces
    count = int(loops.max()) + 1
    vertex, owner = np.full(count, -1), np.full(count, -1)
    uvs = np.zeros((count, 2), np.float32)
    vertex[loops.ravel()], owner[loops.ravel()] = faces.ravel(), np.repeat(of_faces, 3)
    uvs[loops.ravel()] = corner_uvs.reshape(-1, 2)
    agree = (vertex[loops] == faces).all(axis=1) & (owner[loops] == of_faces[:, None]).all(axis=1)
    agree &= (np.abs(uvs[loops] - corner_uvs) <= SAME_UV).all(axis=(1, 2))
    agree &= _ascend(loops)
    number = int(of_faces.max()) + 1
    whole = np.bincount(of_faces, ~agree, number) == 0
    used = np.flatnonzero(owner >= 0)
    sides = np.bincount(owner[used], minlength=number)
    whole &= sides == np.bincount(of_faces, minlength=number) + 2  # one fan of triangles
    pairs = np.unique(np.stack([owner[used], vertex[used]], axis=1), axis=0)
    whole &= np.bincount(pairs[:, 0], minlength=number) == sides  # no vertex twice
    kept = used[whole[owner[used]]]
    kept = kept[np.lexsort((kept, owner[kept]))]
    apart = ~whole[of_faces] & (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return JoinedMesh(
        np.concatenate([vertex[kept], faces[apart].ravel()]).astype(np.int64),
        np.concatenate(
            [_starts(sides[whole & (sides > 0)]), len(kept) + 3 * np.arange(apart.sum())]
        ).astype(np.int64),
        np.concatenate([uvs[kept], corner_uvs[apart].reshape(-1, 2).astype(np.float32)]),
    )


def _ascend(loops: np.ndarray) -> np.ndarray:
    """Return whether the numbers of (f, 3) corners ascend, from whichever corner on."""
    return np.asarray((np.roll(loops, -1, axis=1) > loops).sum(axis=1) == 2)


def _starts(sides: np.ndarray) -> np.ndarray:
    return np.asarray(np.cumsum(sides) - sides)
