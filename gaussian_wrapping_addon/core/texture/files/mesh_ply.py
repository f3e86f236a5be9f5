# SPDX-License-Identifier: GPL-3.0-or-later
"""Write a mesh as PLY: exact coordinates, texture as vertex colours. Needs only numpy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...files import write_bytes
from .file_checks import validate_for_export, write_errors


def write_mesh_ply(
    path: Path, vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray | None = None
) -> None:
    """Write a binary little-endian PLY with double coordinates.

    Parameters
    ----------
    path : Path
        Its folder must exist.
    vertices : (v, 3) float64
        World coordinates; stored losslessly.
    faces : (f, 3) int32
    colors : (v, 3) uint8 or None

    Raises
    ------
    MeshingError
        Not finite, no faces, or an index out of range.
    ResourceError
        The file cannot be written.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    validate_for_export(vertices, faces)
    fields = [(axis, "<f8") for axis in "xyz"]
    names = ["property double x", "property double y", "property double z"]
    if colors is not None:
        fields += [(channel, "u1") for channel in ("red", "green", "blue")]
        names += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    rows = np.empty(len(vertices), np.dtype(fields))
    for column, axis in enumerate("xyz"):
        rows[axis] = vertices[:, column]
    if colors is not None:
        for column, channel in enumerate(("red", "green", "blue")):
            rows[channel] = colors[:, column]
    triangles = np.empty(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", (3,))]))
    triangles["count"] = 3
    triangles["corners"] = faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *names,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    data = "\n".join(header).encode() + rows.tobytes() + triangles.tobytes()
    with write_errors(path):
        write_bytes(path, data)


def vertex_colors(
    count: int,
    faces: np.ndarray,
    corner_uvs: np.ndarray,
    albedos: Sequence[np.ndarray],
    face_atlas: np.ndarray | None = None,
) -> np.ndarray:
    """Return (v, 3) uint8 vertex colours: mean of the texture over the corners of each vertex.

    Parameters
    ----------
    count : int
        Number of vertices.
    faces : (f, 3) int
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
