# SPDX-License-Identifier: GPL-3.0-or-later
"""Validate a mesh before export, also before Blender's exporters.

Exporters write NaN silently, and readers of the file then show nothing or crash.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ...errors import MeshingError, unwritable_error
from ...limits import MAX_ATLASES

SINGLE_MAX = float(np.finfo(np.float32).max)
"""Larger coordinates become infinite in single precision, which most formats use."""


def atlas_file(name: str, atlas: int, udims: Sequence[int] = ()) -> str:
    """Return the file name of a map: ``albedo.png``, then ``albedo-2.png`` and on.

    With UDIM tiles, ``albedo.1001.png`` and on.

    Parameters
    ----------
    name : str
        ``"albedo"``, ``"normal"`` or ``"occlusion"``.
    atlas : int
        From 0.
    udims : sequence of int, optional
        UDIM number of each atlas.
    """
    if udims:
        return f"{name}.{udims[atlas]}.png"
    return f"{name}-{atlas + 1}.png" if atlas else f"{name}.png"


def validate_face_atlas(face_atlas: np.ndarray, faces: int) -> np.ndarray:
    """Validate the atlas indices of faces read from a file; return them as (f,) uint8.

    Raises
    ------
    ValueError
        Not one for each face, not integers, or not below :data:`~.limits.MAX_ATLASES`.
    """
    if face_atlas.shape != (faces,) or face_atlas.dtype.kind not in "iu":
        raise ValueError("face_atlas is not one integer for each face")
    if faces and not 0 <= int(face_atlas.min()) <= int(face_atlas.max()) < MAX_ATLASES:
        raise ValueError("an atlas index of a face is out of range")
    return face_atlas.astype(np.uint8)


def validate_for_export(
    vertices: np.ndarray,
    faces: np.ndarray,
    corner_uvs: np.ndarray | None = None,
    *,
    name: str = "the mesh to write",
) -> None:
    """Raise if a mesh is empty, not finite (also in float32), or has indices out of range.

    Parameters
    ----------
    vertices : (v, 3) float
    faces : (f, 3) int
    corner_uvs : (f, 3, 2) float, optional
    name : str
        Name of the mesh in the error message.

    Raises
    ------
    MeshingError
        States the first invalid element.
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
            f"A face of {name} refers to a vertex that does not exist.", "Mesh the region again."
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
    """Translate ``OSError`` of a path into the package's error."""
    try:
        yield
    except OSError as error:
        raise unwritable_error(path, error) from error
