# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write meshes between stages."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np

from ..array_file import read_arrays
from ..errors import ParseError
from ..files import write_bytes
from .surface_mesh import SurfaceMesh


def save_mesh(path: Path, mesh: SurfaceMesh) -> None:
    """Write vertices, faces and provenance atomically."""
    stream = io.BytesIO()
    provenance = np.frombuffer(json.dumps(mesh.provenance).encode(), np.uint8)
    np.savez(stream, vertices=mesh.vertices, faces=mesh.faces, provenance=provenance)
    write_bytes(path, stream.getvalue())


def load_mesh(path: Path) -> SurfaceMesh:
    """Read a file of :func:`save_mesh`; :class:`ParseError` if it is damaged or none."""
    hint = "Delete the folder and run again."
    arrays = read_arrays(path, ("vertices", "faces", "provenance"), hint=hint)
    try:
        provenance = json.loads(arrays["provenance"].tobytes())
        return SurfaceMesh(arrays["vertices"], arrays["faces"], None, provenance)
    except (ValueError, TypeError) as error:
        raise ParseError(path, "whole file", f"not a mesh file ({error}).", hint) from None
