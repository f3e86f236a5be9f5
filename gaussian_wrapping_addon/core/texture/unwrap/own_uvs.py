# SPDX-License-Identifier: GPL-3.0-or-later
"""Use the UVs that a mesh has: check them, and find the UDIM tiles that they lie in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ... import limits
from ...errors import MeshingError
from ...mesh.face_graph import face_graph, uv_charts
from ...mesh.surface_mesh import SurfaceMesh
from ...mesh.udims import FIRST_UDIM, TILE_COLUMNS, TILE_ROWS
from ...report_warning import ReportWarning
from .unwrap import Unwrap

EDGE_TOLERANCE = 1e-4
"""UVs that leave their tile by less are moved onto its edge: rounding of the program before."""
MAX_FLAT_SHARE = 0.5
"""If faces without UV area are a larger share of the surface, the UVs are refused."""
FLAT_UV_AREA = 1e-12
_NEW_UVS = "Unwrap the mesh, or have new UVs made (--uvs new; in the panel, UVs: New)."


@dataclass(frozen=True)
class OwnUvs:
    """UVs of a mesh, ready for baking."""

    unwrapped: Unwrap
    """UVs within their tile; one atlas for each tile in use."""
    udims: tuple[int, ...]
    """UDIM number of each atlas; ``(1001,)`` for ordinary UVs."""
    warnings: tuple[ReportWarning, ...]


def own_uvs(mesh: SurfaceMesh, corner_uvs: np.ndarray) -> OwnUvs:
    """Check the UVs of a mesh and split them by UDIM tile.

    Parameters
    ----------
    mesh : SurfaceMesh
    corner_uvs : (f, 3, 2) float
        v upwards; tiles are unit squares from (0, 0) on.

    Raises
    ------
    MeshingError
        UVs are not finite, lie outside the tiles, cross from tile to tile, need too many tiles, or
        have hardly any area. Names the first such face.
    """
    uvs = np.array(corner_uvs, np.float64)  # (f, 3, 2)
    _refuse(~np.isfinite(uvs).all(axis=(1, 2)), "has UVs that are not finite")
    graph = face_graph(mesh.vertices, mesh.faces)
    flat = _uv_areas(uvs) <= FLAT_UV_AREA
    share = float(graph.areas[flat].sum() / max(graph.areas.sum(), 1e-300))
    if share > MAX_FLAT_SHARE:
        raise MeshingError(
            f"The UVs of {100 * share:.0f} % of the surface have no area: nothing can be painted "
            "there.",
            _NEW_UVS,
        )
    middle = uvs.mean(axis=1)
    # A collapsed face on the far edge of a tile must not open the next one.
    collapsed = np.maximum(np.ceil(middle) - 1.0, 0.0)
    tile = np.where(flat[:, None], collapsed, np.floor(middle)).astype(np.int64)  # (f, 2)
    inside = uvs - tile[:, None]
    off = np.maximum(-inside, inside - 1.0).max(axis=(1, 2))
    _refuse(
        ((tile < 0) | (tile >= [TILE_COLUMNS, TILE_ROWS])).any(axis=1),
        "has UVs outside of the UDIM tiles (from 0 to 10 and from 0 to 100)",
    )
    _refuse(off > EDGE_TOLERANCE, "has UVs that cross the edge of a tile, as repeated textures do")
    number = tile[:, 0] + TILE_COLUMNS * tile[:, 1]
    tiles, face_atlas = np.unique(number, return_inverse=True)
    if len(tiles) > limits.MAX_ATLASES:
        raise MeshingError(
            f"The UVs lie in {len(tiles)} UDIM tiles; the limit is {limits.MAX_ATLASES}.", _NEW_UVS
        )
    inside = inside.clip(0.0, 1.0).astype(np.float32)
    apart = inside + 2.0 * face_atlas.reshape(-1, 1, 1)
    charts = uv_charts(graph, mesh.faces, apart)
    unwrapped = Unwrap(
        inside, charts, "own", 0.0,
        face_atlas=face_atlas.ravel().astype(np.uint8) if len(tiles) > 1 else None,
    )  # fmt: skip
    warnings = []
    if flat.any():
        text = (
            f"{int(flat.sum())} of {len(flat)} faces have no area in the UV map, {100 * share:.2g} "
            "% of the surface: each shows a single colour."
        )
        warnings.append(ReportWarning("uv-flat", text, _NEW_UVS))
    return OwnUvs(unwrapped, tuple(int(FIRST_UDIM + t) for t in tiles), tuple(warnings))


def overlap_warning(overlapping: int, used: int) -> ReportWarning | None:
    """Return a warning if texels belong to several faces, else ``None``."""
    if overlapping == 0:
        return None
    text = (
        f"{overlapping} of {used} texels are used by several faces: each shows what one of them "
        "sees."
    )
    return ReportWarning("uv-overlap", text, _NEW_UVS)


def uv_area(corner_uvs: np.ndarray) -> float:
    """Return the area of (f, 3, 2) UVs, in squares of a texture; faces that overlap count each."""
    return float(_uv_areas(np.asarray(corner_uvs, np.float64)).sum())


def _uv_areas(uvs: np.ndarray) -> np.ndarray:
    one, other = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    areas: np.ndarray = 0.5 * np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    return areas


def _refuse(bad: np.ndarray, what: str) -> None:
    faces = np.flatnonzero(bad)
    if len(faces):
        more = f" (as do {len(faces)} faces in all)" if len(faces) > 1 else ""
        raise MeshingError(f"Face {int(faces[0])} of the mesh {what}{more}.", _NEW_UVS)
