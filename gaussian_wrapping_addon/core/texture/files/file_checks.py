# SPDX-License-Identifier: GPL-3.0-or-later
"""What no mesh file may hold, asked before any writer sees it, Blender's included.

Those write a NaN without a word, and what reads the file then shows nothing or crashes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...errors import MeshingError, unwritable_error
from ...limits import MAX_ATLASES

SINGLE_MAX = float(np.finfo(np.float32).max)
"""Coordinates beyond become infinite in single precision, which most formats have."""


def atlas_file(name: str, atlas: int) -> str:
    """Return the name of a map's file: ``albedo.png``, then ``albedo-2.png`` and on.

    Parameters
    ----------
    name : str
        ``"albedo"``, ``"normal"`` or ``"occlusion"``.
    atlas : int
        From 0.
    """
    return f"{name}-{atlas + 1}.png" if atlas else f"{name}.png"


def validate_face_atlas(face_atlas: np.ndarray, faces: int) -> np.ndarray:
    """Return (f,) uint8 atlases of faces as a file holds them.

    Raises
    ------
    ValueError
        Not one for each face, no integers, or more than :data:`~.limits.MAX_ATLASES`.
    """
    if face_atlas.shape != (faces,) or face_atlas.dtype.kind not in "iu":
        raise ValueError("face_atlas is not one integer for each face")
    if faces and not 0 <= int(face_atlas.min()) <= int(face_atlas.max()) < MAX_ATLASES:
        raise ValueError("a face lies in an atlas that cannot be")
    return face_atlas.astype(np.uint8)


def validate_for_export(
    vertices: np.ndarray,
    faces: np.ndarray,
    corner_uvs: np.ndarray | None = None,
    *,
    name: str = "the mesh to write",
) -> None:
    """Refuse a mesh that is empty, not finite (also in float32), or names missing vertices.

    Parameters
    ----------
    vertices : (v, 3) float
    faces : (f, 3) int
    corner_uvs : (f, 3, 2) float, optional
    name : str
        What the mesh is called in the error.

    Raises
    ------
    MeshingError
        Names the first place that is wrong.
    """
    subject = name[:1].upper() + name[1:]
    if len(faces) == 0 or len(vertices) == 0:
        raise MeshingError(f"{subject} has no faces.", "Choose a region with a surface.")
    bad = ~(np.abs(vertices) <= SINGLE_MAX).all(axis=1)
    if bad.any():
        raise MeshingError(
            f"Vertex {int(np.argmax(bad))} of {name} is not finite.", "Mesh the region again."
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshingError(
            f"A face of {name} names a vertex that does not exist.", "Mesh the region again."
        )
    if corner_uvs is None:
        return
    bad = ~(np.abs(corner_uvs) <= SINGLE_MAX).reshape(len(faces), -1).all(axis=1)
    if bad.any():
        raise MeshingError(
            f"Face {int(np.argmax(bad))} of {name} has UVs that are not finite.",
            "Texture the region again.",
        )


@contextlib.contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Turn what the system says of a path into our error."""
    try:
        yield
    except OSError as error:
        raise unwritable_error(path, error) from error
