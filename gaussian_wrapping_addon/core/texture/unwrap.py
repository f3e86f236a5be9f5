# SPDX-License-Identifier: GPL-3.0-or-later
"""UV unwrap: charts and packing by xatlas, checked; a box projection to fall back on."""

from __future__ import annotations

import logging
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DatasetError, ResourceError, WorkerError
from ..meshing.surface_mesh import SurfaceMesh
from ..progress import Progress
from .atlas_raster import raster_atlas
from .box_unwrap import box_unwrap
from .charts import find_charts, pack_charts
from .face_graph import FaceGraph, face_graph, uv_charts

_logger = logging.getLogger(__name__)

FLAT_FACE_AREA = 1e-6
"""Faces of less than this share of the squared median edge are not given to xatlas."""
MAX_IGNORED_AREA_SHARE = 1e-3
CHECK_SIZE_PX = 2048
MAX_REASON = 200
"""Characters of a helper's last words that go into the report."""


@dataclass(frozen=True)
class Unwrap:
    """UVs of a mesh and how they were made."""

    corner_uvs: np.ndarray
    """(f, 3, 2) float32 in [0, 1], v upwards; faces without area are collapsed to a point."""
    charts: np.ndarray
    """(f,) int32 labels of charts."""
    method: str
    """``"xatlas"`` or ``"box"``."""
    gutter_px: float
    """Texels kept free between charts at the size asked for."""
    reason: str = ""
    """Why the fallback was used."""


def unwrap(
    mesh: SurfaceMesh,
    size_px: int,
    gutter_px: int,
    work_folder: Path,
    progress: Progress,
    *,
    threads: int = 1,
) -> Unwrap:
    """Give every face corner a UV, without overlaps.

    Parameters
    ----------
    mesh : SurfaceMesh
        Checked mesh: finite, at least one face with area.
    size_px, gutter_px : int
        Side of the texture and texels to keep free between charts.
    work_folder : Path
        A folder for a temporary sub-folder, removed before returning.
    progress : Progress
        Span of this step.

    Notes
    -----
    xatlas crashes, hangs or answers NaN on some meshes (conventions.md D.2). Whatever it does, a
    box projection takes its place, with a warning and ``method = "box"``.
    """
    graph = face_graph(mesh.vertices, mesh.faces)
    try:
        corner_uvs, gutter_left_px = _xatlas(
            mesh, graph, size_px, gutter_px, work_folder, progress.span(0.0, 0.9), threads
        )
        method, reason = "xatlas", ""
    except (WorkerError, ResourceError, DatasetError) as error:
        reason = error.message[:MAX_REASON]
        _logger.warning("xatlas could not unwrap the mesh (%s): box projection instead", reason)
        corner_uvs, gutter_left_px = box_unwrap(
            mesh, graph, size_px, gutter_px, progress.span(0.0, 0.9)
        )
        method = "box"
        problem = _problem(corner_uvs, graph, size_px, threads)
        if problem:
            _logger.warning("the box projection is not perfect: %s", problem)
    if gutter_left_px < gutter_px:
        _logger.warning(
            "the texture is too small for %d texels between charts: %.1f are kept",
            gutter_px,
            gutter_left_px,
        )
    progress.update(0.95, "finding charts")
    charts = uv_charts(graph, mesh.faces, corner_uvs)
    progress.update(1.0, f"unwrapped with {method}")
    return Unwrap(corner_uvs, charts, method, float(gutter_left_px), reason)


def _xatlas(
    mesh: SurfaceMesh,
    graph: FaceGraph,
    size_px: int,
    gutter_px: int,
    work_folder: Path,
    progress: Progress,
    threads: int,
) -> tuple[np.ndarray, float]:
    corners = mesh.vertices[mesh.faces]
    if not np.isfinite(corners).all():
        raise DatasetError("Vertices of the mesh are not finite.")
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    unit = float(np.median(edges[edges > 0]))
    solid = np.flatnonzero(graph.areas > FLAT_FACE_AREA * unit**2)
    if len(solid) == 0:
        raise DatasetError("No face of the mesh has an area.")
    # xatlas has absolute tolerances: median edge 1, centre 0 suits them.
    scaled = (mesh.vertices - mesh.vertices.mean(axis=0)) / unit
    faces = mesh.faces[solid]
    work_folder.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="unwrap-", dir=work_folder))
    try:
        charts = find_charts(scaled, faces, size_px, gutter_px, folder, progress.span(0.0, 0.7))
        texture_uvs, gutter_left_px = pack_charts(
            charts, size_px, gutter_px, folder, progress.span(0.7, 0.9)
        )
    except (OSError, ValueError, KeyError) as error:
        raise WorkerError(f"xatlas left no usable result ({error}).") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    progress.update(0.9, "checking the unwrap")
    corner_uvs = np.full((len(mesh.faces), 3, 2), np.nan, np.float32)
    corner_uvs[solid[charts.faces]] = texture_uvs
    _collapse_ignored(corner_uvs, mesh.faces, graph)
    problem = _problem(corner_uvs, graph, size_px, threads)
    if problem:
        raise DatasetError(f"The UVs that xatlas made cannot be used: {problem}.")
    return corner_uvs, gutter_left_px


def _collapse_ignored(corner_uvs: np.ndarray, faces: np.ndarray, graph: FaceGraph) -> None:
    """Give faces without UVs one point of the atlas: that of a face at the same vertex."""
    missing = ~np.isfinite(corner_uvs).all(axis=(1, 2))
    if not missing.any():
        return
    share = graph.areas[missing].sum() / graph.areas.sum()
    if share > MAX_IGNORED_AREA_SHARE:
        raise DatasetError(f"xatlas ignored {100 * share:.2f} % of the surface.")
    known = np.flatnonzero(~missing)
    uv_of_vertex = np.full((int(faces.max()) + 1, 2), np.nan, np.float32)
    uv_of_vertex[faces[known].ravel()] = corner_uvs[known].reshape(-1, 2)
    options = uv_of_vertex[faces[missing]]  # (m, 3, 2), NaN where the vertex has none
    anywhere = corner_uvs[known[0], 0]
    point = np.full((len(options), 2), np.nan, np.float32)
    for corner in range(3):
        point = np.where(np.isfinite(point), point, options[:, corner])
    point = np.where(np.isfinite(point), point, anywhere)
    corner_uvs[missing] = point[:, None, :]


def _problem(corner_uvs: np.ndarray, graph: FaceGraph, size_px: int, threads: int) -> str:
    """Say what is wrong with the UVs; empty when nothing is."""
    if not np.isfinite(corner_uvs).all():
        return "some are not finite"
    if corner_uvs.min() < 0.0 or corner_uvs.max() > 1.0:
        return "some lie outside of 0 to 1"
    raster = raster_atlas(corner_uvs, min(size_px, CHECK_SIZE_PX), threads)
    used = int(raster.inside.sum())
    if used == 0:
        return "no texel is used"
    if raster.overlaps > 0:
        return f"{raster.overlaps} of {used} texels are used twice"
    return ""
