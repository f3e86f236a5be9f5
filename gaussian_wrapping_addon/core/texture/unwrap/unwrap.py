# SPDX-License-Identifier: GPL-3.0-or-later
"""UVs of a mesh: charts and packing, or the mesh's own."""

from __future__ import annotations

import logging
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ... import limits
from ...errors import (
    DISK_FULL_ERRNOS,
    DatasetError,
    MemoryShortageError,
    MeshingError,
    ResourceError,
    WorkerError,
    unwritable_error,
)
from ...mesh.components import FaceGraph, face_graph, uv_charts
from ...mesh.surface_mesh import SurfaceMesh, edge_lengths
from ...mesh.textured_mesh import FIRST_UDIM, TILE_COLUMNS, TILE_ROWS
from ...progress import Progress, ReportWarning
from ..atlas import AtlasRaster, raster_atlas
from .charts import find_charts, pack_charts
from .overlaps import connected_pieces, split_overlaps
from .packing_scale import chart_bounds, signed_areas, split_wide_charts

# -- Fallback unwrap: box projection along the axes, charts packed in shelves ---------------------


SMOOTHING_ROUNDS = 8
NEIGHBOUR_VOTE = 0.4
MIN_COSINE = 0.15
"""A face may be projected along an axis up to 81 degrees from its normal."""
SCALE_STEPS = 24

_AXES = np.repeat(np.eye(3), 2, axis=0) * np.array([[1.0], [-1.0]] * 3)
# For each signed axis, the two axes of a projection that is counter-clockwise from outside.
_PLANES = ((1, 2), (2, 1), (2, 0), (0, 2), (0, 1), (1, 0))


def box_unwrap(
    mesh: SurfaceMesh, graph: FaceGraph, size_px: int, gutter_px: int, progress: Progress,
    atlases: int,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """Unwrap by projection along the six axis directions; charts with overlaps are split.

    Returns what :func:`.charts.pack_charts` does.
    """
    axis = _axis_of_faces(graph)
    corners = mesh.vertices[mesh.faces]
    plane = np.array(_PLANES)[axis]  # (f, 2)
    flat = np.take_along_axis(corners, plane[:, None, :], axis=2)  # (f, 3, 2)
    progress.update(0.2, "box projection")
    charts = connected_pieces(graph, axis)
    charts = split_overlaps(flat - corners.mean(axis=(0, 1))[plane][:, None, :], charts, graph)
    progress.update(0.6, "box projection: packing")
    if atlases > 1:
        charts = split_wide_charts(flat, charts, atlases)
    return _pack(flat, charts, size_px, gutter_px, atlases)


def _axis_of_faces(graph: FaceGraph) -> np.ndarray:
    """Choose a direction for each face, smoothed so that noise does not fragment charts."""
    cosines = graph.normals @ _AXES.T  # (f, 6)
    axis = cosines.argmax(axis=1)
    rows = np.arange(len(axis))
    for _ in range(SMOOTHING_ROUNDS):
        votes = np.zeros_like(cosines)
        for corner in range(3):
            has = graph.opposite[:, corner] >= 0
            votes[rows[has], axis[graph.opposite[has, corner] // 3]] += NEIGHBOUR_VOTE
        allowed = cosines > MIN_COSINE
        allowed[rows, cosines.argmax(axis=1)] = True
        chosen = np.where(allowed, cosines + votes, -np.inf).argmax(axis=1)
        if (chosen == axis).all():
            break
        axis = chosen
    return axis


def _pack(
    flat: np.ndarray, charts: np.ndarray, size_px: int, gutter_px: int, atlases: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Pack charts in shelves at the largest scale that fits; reduce the gutters if none does."""
    low, high = chart_bounds(flat, charts)
    extent = high - low
    turned = extent[:, 1] > extent[:, 0]  # wide charts make lower shelves
    lying = np.where(turned[:, None], extent[:, ::-1], extent)
    gutter = float(gutter_px)
    while True:
        scale, positions = _largest_scale(lying, size_px, gutter, atlases)
        if positions is not None or gutter < 0.01:
            break
        gutter *= 0.7
    assert positions is not None
    local = (flat - low[charts][:, None, :]) * scale  # (f, 3, 2)
    width = extent[charts, 0][:, None] * scale
    # A rotation by 90 degrees keeps the orientation: (x, y) -> (y, width - x).
    quarter = np.stack([local[..., 1], width - local[..., 0]], axis=-1)
    local = np.where(turned[charts][:, None, None], quarter, local)
    corner_uvs = (local + positions[charts][:, None, :2]) / size_px
    face_atlas = positions[charts, 2].astype(np.uint8)
    return np.clip(corner_uvs, 0.0, 1.0).astype(np.float32), face_atlas, gutter


def _largest_scale(
    extent: np.ndarray, size_px: int, gutter: float, atlases: int
) -> tuple[float, np.ndarray | None]:
    high = size_px / max(float(extent.max()), 1e-300)
    best = _shelves(extent * high, size_px, gutter, atlases)
    if best is not None:
        return high, best
    # Below a hundredth of the largest scale, charts would have no texels.
    low = 0.01 * high
    best = _shelves(extent * low, size_px, gutter, atlases)
    if best is None:
        if gutter >= 0.01:
            return low, None
        low, best = 0.0, np.zeros((len(extent), 3))
    for _ in range(SCALE_STEPS):
        middle = 0.5 * (low + high)
        positions = _shelves(extent * middle, size_px, gutter, atlases)
        if positions is None:
            high = middle
        else:
            low, best = middle, positions
    return low, best


def _shelves(extent_px: np.ndarray, size_px: int, gutter: float, atlases: int) -> np.ndarray | None:
    """Return x, y of the lower left corner of each box and its atlas; ``None`` without room."""
    if float(np.prod(extent_px + gutter, axis=1).sum()) > atlases * float(size_px) ** 2:
        return None
    order = np.argsort(-extent_px[:, 1], kind="stable")
    positions = np.empty((len(extent_px), 3))
    atlas = 0
    x, y, shelf = 0.5 * gutter, 0.5 * gutter, 0.0
    for index in order.tolist():
        width, height = extent_px[index]
        if x + width + 0.5 * gutter > size_px and x > 0.5 * gutter:
            x, y = 0.5 * gutter, y + shelf + gutter
            shelf = 0.0
        if y + height + 0.5 * gutter > size_px and y > 0.5 * gutter and atlas + 1 < atlases:
            atlas += 1
            x, y, shelf = 0.5 * gutter, 0.5 * gutter, 0.0
        if x + width + 0.5 * gutter > size_px or y + height + 0.5 * gutter > size_px:
            return None
        positions[index] = x, y, atlas
        x += width + gutter
        shelf = max(shelf, height)
    return positions


# -- UV unwrap: charts and packing by xatlas, validated, with a box projection as fallback --------


_logger = logging.getLogger(__name__)

FLAT_FACE_AREA = 1e-6
"""Faces with less area than this share of the squared median edge are not passed to xatlas."""
MAX_IGNORED_AREA_SHARE = 1e-3
CHECK_SIZE_PX = 2048
MAX_REASON = 200
"""Maximum number of characters of a helper's error message in the report."""


@dataclass(frozen=True)
class Unwrap:
    """UVs of a mesh and the method of the unwrap."""

    corner_uvs: np.ndarray
    """(f, 3, 2) float32 in [0, 1], v upwards; faces without area are collapsed to a point."""
    charts: np.ndarray
    """(f,) int32 labels of charts."""
    method: str
    """``"xatlas"`` or ``"box"``."""
    gutter_px: float
    """Texels kept free between charts at the requested size."""
    reason: str = ""
    """Why the fallback was used."""
    face_atlas: np.ndarray | None = None
    """(f,) uint8 atlas of each face, from 0; None with a single atlas."""

    @property
    def atlases(self) -> int:
        """Number of atlases."""
        return 1 if self.face_atlas is None else int(self.face_atlas.max()) + 1

    def raster(self, size_px: int, threads: int, atlas: int = 0) -> AtlasRaster:
        """Rasterise one atlas."""
        faces = None if self.face_atlas is None else self.face_atlas == atlas
        return raster_atlas(self.corner_uvs, size_px, threads, faces)


def unwrap(
    mesh: SurfaceMesh, size_px: int, gutter_px: int, work_folder: Path, progress: Progress, *,
    threads: int = 1, atlases: int = 1, polygons: np.ndarray | None = None,
) -> Unwrap:  # fmt: skip
    """Compute UVs for all face corners of a finite mesh with some area, without overlaps.

    xatlas crashes, hangs or returns NaN on some meshes. In these cases a box projection replaces
    it, with a warning and ``method = "box"``.

    Parameters
    ----------
    size_px, gutter_px : int
        Side of the texture and texels to keep free between charts.
    work_folder : Path
        Folder for a temporary sub-folder, which is removed before returning.
    atlases : int
        Maximum number of textures for the charts, all at the same density.
    polygons : (f,) int64, optional
        Polygon that each face is a part of: seams run between polygons, not through them, but for
        folded ones with more than four sides, and the fallback.

    Raises
    ------
    MemoryShortageError
        The system gave xatlas too little memory.
    ResourceError
        The disk is full.
    """
    graph = face_graph(mesh.vertices, mesh.faces)
    try:
        corner_uvs, face_atlas, gutter_left_px = _xatlas(
            mesh, graph, size_px, gutter_px, work_folder, progress.span(0.0, 0.9), threads, atlases,
            polygons,
        )  # fmt: skip
        method, reason = "xatlas", ""
    except (WorkerError, ResourceError, DatasetError) as error:
        # A full disk: nothing else could be written either. Or memory is short today: the texture
        # would depend on it.
        if isinstance(error, MemoryShortageError) or isinstance(error.__cause__, OSError):
            raise
        reason = error.message[:MAX_REASON]
        _logger.warning("xatlas could not unwrap the mesh (%s): using box projection", reason)
        corner_uvs, face_atlas, gutter_left_px = box_unwrap(
            mesh, graph, size_px, gutter_px, progress.span(0.0, 0.9), atlases
        )
        method = "box"
        defect = _find_defect(corner_uvs, face_atlas, size_px, threads)
        if defect:
            _logger.warning("the box projection has defects: %s", defect)
    if gutter_left_px < gutter_px:
        _logger.warning(
            "the texture is too small for gutters of %d texels between charts: using %.1f",
            gutter_px, gutter_left_px,
        )  # fmt: skip
    progress.update(0.95, "finding charts")
    # Atlases share the unit square: shifted apart, charts of different atlases cannot touch.
    apart = corner_uvs + 2.0 * face_atlas.astype(np.float64)[:, None, None]
    charts = uv_charts(graph, mesh.faces, apart)
    progress.update(1.0, f"unwrapped with {method}")
    used = None
    if face_atlas.any():  # without gaps, from 0
        used = np.unique(face_atlas, return_inverse=True)[1].ravel().astype(np.uint8)
    return Unwrap(corner_uvs, charts, method, float(gutter_left_px), reason, used)


def _xatlas(
    mesh: SurfaceMesh, graph: FaceGraph, size_px: int, gutter_px: int, work_folder: Path,
    progress: Progress, threads: int, atlases: int = 1, polygons: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    corners = mesh.vertices[mesh.faces]
    if not np.isfinite(corners).all():
        raise DatasetError("Vertices of the mesh are not finite.")
    edges = edge_lengths(mesh.vertices, mesh.faces)
    unit = float(np.median(edges[edges > 0]))
    solid = np.flatnonzero(graph.areas > FLAT_FACE_AREA * unit**2)
    if len(solid) == 0:
        raise DatasetError("No face of the mesh has an area.")
    # xatlas has absolute tolerances, which suit a median edge of 1 and centre 0.
    scaled = (mesh.vertices - mesh.vertices.mean(axis=0)) / unit
    faces = mesh.faces[solid]
    work_folder.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="unwrap-", dir=work_folder))
    try:
        charts = find_charts(
            scaled, faces, size_px, gutter_px, folder, progress.span(0.0, 0.7), atlases,
            None if polygons is None else polygons[solid],
        )  # fmt: skip
        texture_uvs, chart_atlas, gutter_left_px = pack_charts(
            charts, size_px, gutter_px, folder, progress.span(0.7, 0.9), atlases
        )
    except (OSError, ValueError, KeyError) as error:
        if isinstance(error, OSError) and error.errno in DISK_FULL_ERRNOS:
            raise unwritable_error(error.filename or folder, error) from error
        raise WorkerError(f"xatlas returned no usable result ({error}).") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    progress.update(0.9, "checking the unwrap")
    corner_uvs = np.full((len(mesh.faces), 3, 2), np.nan, np.float32)
    corner_uvs[solid[charts.faces]] = texture_uvs
    face_atlas = np.zeros(len(mesh.faces), np.uint8)
    face_atlas[solid[charts.faces]] = chart_atlas
    _collapse_ignored(corner_uvs, face_atlas, mesh.faces, graph)
    defect = _find_defect(corner_uvs, face_atlas, size_px, threads)
    if defect:
        raise DatasetError(f"The UVs returned by xatlas are invalid: {defect}.")
    return corner_uvs, face_atlas, gutter_left_px


def _collapse_ignored(
    corner_uvs: np.ndarray, face_atlas: np.ndarray, faces: np.ndarray, graph: FaceGraph
) -> None:
    """Collapse faces without UVs to a point of the atlas: that of a face at the same vertex."""
    missing = ~np.isfinite(corner_uvs).all(axis=(1, 2))
    if not missing.any():
        return
    share = graph.areas[missing].sum() / graph.areas.sum()
    if share > MAX_IGNORED_AREA_SHARE:
        raise DatasetError(f"xatlas ignored {100 * share:.2f} % of the surface.")
    known = np.flatnonzero(~missing)
    corner_of_vertex = np.full(int(faces.max()) + 1, -1)
    corner_of_vertex[faces[known].ravel()] = (3 * known[:, None] + np.arange(3)).ravel()
    options = corner_of_vertex[faces[missing]]  # (m, 3), -1 where the vertex has none
    chosen = np.full(len(options), -1)
    for corner in range(3):
        chosen = np.where(chosen >= 0, chosen, options[:, corner])
    chosen = np.where(chosen >= 0, chosen, 3 * known[0])
    corner_uvs[missing] = corner_uvs.reshape(-1, 2)[chosen][:, None, :]
    face_atlas[missing] = face_atlas[chosen // 3]


def _find_defect(corner_uvs: np.ndarray, face_atlas: np.ndarray, size_px: int, threads: int) -> str:
    """Return a description of the first defect of the UVs; empty without one."""
    if not np.isfinite(corner_uvs).all():
        return "some are not finite"
    if corner_uvs.min() < 0.0 or corner_uvs.max() > 1.0:
        return "some lie outside 0 to 1"
    used = overlaps = 0
    for number in np.unique(face_atlas).tolist():
        faces = face_atlas == number
        raster = raster_atlas(corner_uvs, min(size_px, CHECK_SIZE_PX), threads, faces)
        used += int(raster.inside.sum())
        overlaps += raster.overlaps
    if used == 0:
        return "no texel is used"
    if overlaps > 0:
        return f"{overlaps} of {used} texels are used twice"
    return ""


# -- Use the UVs that a mesh has: check them, and find the UDIM tiles that they lie in ------------


EDGE_TOLERANCE = 1e-4
"""UVs that leave their tile by less are moved onto its edge: rounding of the program before."""
MAX_FLAT_SHARE = 0.5
"""If faces without UV area are a larger share of the surface, the UVs are refused."""
FLAT_UV_AREA = 1e-12
_NEW_UVS = "Unwrap the mesh, or have new UVs made (--uvs new; in the panel, UVs: New)."


@dataclass(frozen=True)
class OwnUvs:
    """UVs of a mesh, ready for baking."""

    unwrapped: Unwrap  # UVs within their tile; one atlas for each tile in use
    udims: tuple[int, ...]  # UDIM number of each atlas; ``(1001,)`` for ordinary UVs
    warnings: tuple[ReportWarning, ...]


def own_uvs(mesh: SurfaceMesh, corner_uvs: np.ndarray) -> OwnUvs:
    """Check the UVs of a mesh and split them by UDIM tile.

    UVs are (f, 3, 2), v upwards; tiles are unit squares from (0, 0) on.

    Raises
    ------
    MeshingError
        UVs are not finite, lie outside the tiles, cross from tile to tile, need too many tiles, or
        have hardly any area. Names the first such face.
    """
    uvs = np.array(corner_uvs, np.float64)  # (f, 3, 2)
    _refuse(~np.isfinite(uvs).all(axis=(1, 2)), "has UVs that are not finite")
    graph = face_graph(mesh.vertices, mesh.faces)
    flat = np.abs(signed_areas(uvs)) <= FLAT_UV_AREA
    share = float(graph.areas[flat].sum() / max(graph.areas.sum(), 1e-300))
    if share > MAX_FLAT_SHARE:
        text = f"The UVs of {100 * share:.0f} % of the surface have no area: nothing can be "
        raise MeshingError(text + "painted there.", _NEW_UVS)
    middle = uvs.mean(axis=1)
    # A collapsed face on the far edge of a tile must not open the next one.
    collapsed = np.maximum(np.ceil(middle) - 1.0, 0.0)
    tile = np.where(flat[:, None], collapsed, np.floor(middle)).astype(np.int64)  # (f, 2)
    inside = uvs - tile[:, None]
    off = np.maximum(-inside, inside - 1.0).max(axis=(1, 2))
    outside = ((tile < 0) | (tile >= [TILE_COLUMNS, TILE_ROWS])).any(axis=1)
    _refuse(outside, "has UVs outside of the UDIM tiles (from 0 to 10 and from 0 to 100)")
    _refuse(off > EDGE_TOLERANCE, "has UVs that cross the edge of a tile, as repeated textures do")
    number = tile[:, 0] + TILE_COLUMNS * tile[:, 1]
    tiles, face_atlas = np.unique(number, return_inverse=True)
    if len(tiles) > limits.MAX_ATLASES:
        text = f"The UVs lie in {len(tiles)} UDIM tiles; the limit is {limits.MAX_ATLASES}."
        raise MeshingError(text, _NEW_UVS)
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
    return float(np.abs(signed_areas(np.asarray(corner_uvs, np.float64))).sum())


def _refuse(bad: np.ndarray, what: str) -> None:
    faces = np.flatnonzero(bad)
    if len(faces):
        more = f" (as do {len(faces)} faces in all)" if len(faces) > 1 else ""
        raise MeshingError(f"Face {int(faces[0])} of the mesh {what}{more}.", _NEW_UVS)
