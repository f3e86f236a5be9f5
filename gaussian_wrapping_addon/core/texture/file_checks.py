# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of meshes and images before they are written; PLY files."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ..errors import MeshingError, unwritable_error
from ..files import write_bytes
from ..limits import MAX_ATLASES

# -- Roughness and specular level of lit materials, the same in Blender and in every file format


ROUGHNESS = 0.9
"""Photos contain their lighting: added gloss would look wrong from most directions."""
SPECULAR_LEVEL = 0.1
"""Blender's scale: 0.5 is a reflectance of 4 %, which corresponds to glTF's factor 1."""
OBJ_SHININESS = 1000.0 * (1.0 - ROUGHNESS) ** 2
"""``Ns`` of OBJ as Blender maps it to roughness; other programs use it as Phong exponent."""


# -- Validate a mesh before export, also before Blender's exporters -------------------------------
#
# Exporters write NaN silently, and readers of the file then show nothing or crash.


SINGLE_MAX = float(np.finfo(np.float32).max)
"""Larger coordinates become infinite in single precision, which most formats use."""


def atlas_file(name: str, atlas: int, udims: Sequence[int] = ()) -> str:
    """Return the file name of a map of an atlas (from 0): ``albedo.png``, then ``albedo-2.png``.

    With UDIM numbers of the atlases, ``albedo.1001.png`` and on.
    """
    if udims:
        return f"{name}.{udims[atlas]}.png"
    return f"{name}-{atlas + 1}.png" if atlas else f"{name}.png"


def validate_face_atlas(face_atlas: np.ndarray, faces: int) -> np.ndarray:
    """Return the atlas indices of faces read from a file as (f,) uint8.

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
    vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray | None = None, *,
    name: str = "the mesh to write",
) -> None:  # fmt: skip
    """Raise if a mesh is empty, not finite (also in float32), or has indices out of range.

    UVs, if any, are (f, 3, 2); ``name`` is that of the mesh in the error message.

    Raises
    ------
    MeshingError
        States the first invalid element.
    """
    subject, again = name[:1].upper() + name[1:], "Mesh the region again."
    if len(faces) == 0 or len(vertices) == 0:
        raise MeshingError(f"{subject} has no faces.", "Choose a region with a surface.")
    bad = ~(np.abs(vertices) <= SINGLE_MAX).all(axis=1)
    if bad.any():
        raise MeshingError(f"Vertex {int(np.argmax(bad))} of {name} is not finite.", again)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshingError(f"A face of {name} refers to a vertex that does not exist.", again)
    if corner_uvs is None:
        return
    bad = ~(np.abs(corner_uvs) <= SINGLE_MAX).reshape(len(faces), -1).all(axis=1)
    if bad.any():
        text = f"Face {int(np.argmax(bad))} of {name} has UVs that are not finite."
        raise MeshingError(text, "Texture the region again.")


@contextlib.contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Translate ``OSError`` of a path into the package's error."""
    try:
        yield
    except OSError as error:
        raise unwritable_error(path, error) from error


# -- Write a mesh as PLY: exact coordinates, texture as vertex colours. Needs only numpy ----------


def write_mesh_ply(
    path: Path, vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray | None = None
) -> None:
    """Write a binary little-endian PLY with double coordinates into an existing folder.

    Vertices are (v, 3), world frame, stored losslessly; faces (f, 3); colours (v, 3) uint8.

    Raises
    ------
    MeshingError
        Not finite, no faces, or an index out of range.
    ResourceError
        The file cannot be written.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    validate_for_export(vertices, faces)
    columns = dict(zip("xyz", vertices.T, strict=True))
    fields = [(axis, "<f8") for axis in columns]
    names = [f"property double {axis}" for axis in columns]
    if colors is not None:
        channels = dict(zip(("red", "green", "blue"), colors.T, strict=True))
        fields += [(channel, "u1") for channel in channels]
        names += [f"property uchar {channel}" for channel in channels]
        columns |= channels
    rows = np.empty(len(vertices), np.dtype(fields))
    for name, values in columns.items():
        rows[name] = values
    triangles = np.empty(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", (3,))]))
    triangles["count"] = 3
    triangles["corners"] = faces
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *names,
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    data = "\n".join(header).encode() + rows.tobytes() + triangles.tobytes()
    with write_errors(path):
        write_bytes(path, data)


def vertex_colors(
    count: int, faces: np.ndarray, corner_uvs: np.ndarray, albedos: Sequence[np.ndarray],
    face_atlas: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return uint8 colours of ``count`` vertices: mean of the texture over the corners of each.

    Parameters
    ----------
    corner_uvs : (f, 3, 2) float
        v upwards.
    albedos : sequence of (h, w, 3) uint8
        One per atlas; the first row is the top.
    face_atlas : (f,) int, optional
        Atlas of each face, if there are several.
    """
    uvs = np.asarray(corner_uvs, np.float64).reshape(-1, 2)
    atlas = np.zeros(len(uvs), np.int64) if face_atlas is None else np.repeat(face_atlas, 3)
    values = np.zeros((len(uvs), 3))
    for number, albedo in enumerate(albedos):
        here = np.flatnonzero(atlas == number)
        size = np.array(albedo.shape[1::-1])
        texels = uvs[here] * size
        column = np.floor(texels[:, 0]).clip(0, size[0] - 1).astype(np.int64)
        row = np.floor(size[1] - texels[:, 1]).clip(0, size[1] - 1).astype(np.int64)
        values[here] = albedo[row, column]
    corner = np.asarray(faces).ravel()
    corners = np.bincount(corner, minlength=count)
    sums = [np.bincount(corner, values[:, c], count) for c in range(3)]
    return np.rint(np.stack(sums, axis=1) / np.maximum(corners, 1)[:, None]).astype(np.uint8)
