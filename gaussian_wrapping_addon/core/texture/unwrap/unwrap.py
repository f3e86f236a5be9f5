# SPDX-License-Identifier: GPL-3.0-or-later
"""UV unwrap: charts and packing by xatlas, validated, with a box projection as fallback."""

from __future__ import annotations

import logging
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import (
    DISK_FULL_ERRNOS,
    DatasetError,
    MemoryShortageError,
    ResourceError,
    WorkerError,
    unwritable_error,
)
from ...mesh.face_graph import FaceGraph, face_graph, uv_charts
from ...mesh.surface_mesh import SurfaceMesh
from ...mesh.topology import edge_lengths
from ...progress import Progress
from ..atlas.atlas_raster import AtlasRaster, raster_atlas
from .box_unwrap import box_unwrap
from .charts import find_charts, pack_charts

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
    mesh: SurfaceMesh,
    size_px: int,
    gutter_px: int,
    work_folder: Path,
    progress: Progress,
    *,
    threads: int = 1,
    atlases: int = 1,
    polygons: np.ndarray | None = None,
) -> Unwrap:
    """Compute UVs for all face corners, without overlaps.

    Parameters
    ----------
    mesh : SurfaceMesh
        Valid mesh: finite, at least one face with area.
    size_px, gutter_px : int
        Side of the texture and texels to keep free between charts.
    work_folder : Path
        Folder for a temporary sub-folder, which is removed before returning.
    progress : Progress
        Span of this step.
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

    Notes
    -----
    xatlas crashes, hangs or returns NaN on some meshes. In these cases a box projection replaces
    it, with a warning and ``method = "box"``.
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
            gutter_px,
            gutter_left_px,
        )
    progress.update(0.95, "finding charts")
    # Atlases share the unit square: shifted apart, charts of different atlases cannot touch.
    apart = corner_uvs + 2.0 * face_atlas.astype(np.float64)[:, None, None]
    charts = uv_charts(graph, mesh.faces, apart)
    progress.update(1.0, f"unwrapped with {method}")
    return Unwrap(
        corner_uvs, charts, method, float(gutter_left_px), reason,
        _renumber(face_atlas) if face_atlas.any() else None,
    )  # fmt: skip


def _renumber(face_atlas: np.ndarray) -> np.ndarray:
    """Renumber the used atlases from 0, without gaps."""
    return np.unique(face_atlas, return_inverse=True)[1].ravel().astype(np.uint8)


def _xatlas(
    mesh: SurfaceMesh,
    graph: FaceGraph,
    size_px: int,
    gutter_px: int,
    work_folder: Path,
    progress: Progress,
    threads: int,
    atlases: int = 1,
    polygons: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:
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
