# SPDX-License-Identifier: GPL-3.0-or-later
"""What no mesh file may hold, asked before any writer sees it, Blender's included.

Those write a NaN without a word, and what reads the file then shows nothing or crashes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import MeshingError, ResourceError

SINGLE_MAX = float(np.finfo(np.float32).max)
"""Coordinates beyond become infinite in single precision, which most formats have."""


def check_mesh(
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
def writing(path: Path) -> Iterator[None]:
    """Turn what the system says of a path into our error."""
    try:
        yield
    except OSError as error:
        raise ResourceError(
            f"{path} cannot be written: {error.strerror or error}.",
            "Check that the folder exists, is not read-only, and that the disk has room.",
        ) from error
