# SPDX-License-Identifier: GPL-3.0-or-later
"""Find charts of a mesh with xatlas in a helper process, without folds, and pack them."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ...errors import DatasetError, MemoryShortageError, ResourceError, WorkerError
from ...mesh.face_graph import face_graph, uv_charts
from ...processes.helper_process import run_helper
from ...progress import Progress
from .chart_boxes import chart_extents, packing_scale, packing_square, split_wide_charts
from .chart_overlaps import signed_areas, split_overlaps
from .chart_shapes import chart_points, equalise_density, flatten_faces, relax, smooth_vertices
from .chunks import split_into_chunks
from .stretch import Stretch, texture_stretch
from .whole_polygons import join_polygons, set_cut_apart

_logger = logging.getLogger(__name__)

CHARTS_HELPER = "texture.unwrap.unwrap_helper"
PACK_HELPER = "texture.unwrap.pack_helper"
HELPER_MEMORY_BYTES = 8 * 2**30
DEADLINE_BASE_S = 30.0
DEADLINE_PER_FACE_S = 1e-3
"""Noisy meshes take about 1e-4 s per face, with packing; ten times that is a hang."""
MAX_MEAN_STRETCH = 1.1
"""With more mean stretch of the charts of the smoothed copy, the mesh itself is charted too."""
MIN_DENSITY_GAIN = 1.2
"""Factor in texels per edge by which the charts of the mesh itself must be better: there are many
more of them, each with seams, and bounding boxes favour small charts."""
MAX_LOST_SHARE = 1e-3
"""The mesh itself is charted too if a larger share of the surface has no area in the charts."""


@dataclass(frozen=True)
class Charts:
    """Charts in the plane, each at the scale of the surface, not yet packed."""

    faces: np.ndarray
    """(k,) int64 indices of the given faces that have a chart."""
    corner_uvs: np.ndarray
    """(k, 3, 2) float64."""
    labels: np.ndarray
    """(k,) int32."""
    stretch: Stretch
    polygons: np.ndarray | None = None
    """(k,) int64 polygon of each face, if polygons are to stay whole."""

    def density(self, size_px: int, gutter_px: int, atlases: int = 1) -> float:
        """Return the approximate texels per edge on all but 5 % of the surface."""
        corners = np.arange(self.corner_uvs.size // 2).reshape(-1, 3)
        extents = chart_extents(self.corner_uvs.reshape(-1, 2), corners, self.labels)
        side_px, padding_px = packing_square(size_px, gutter_px)
        scale = packing_scale(extents, side_px, padding_px, atlases) * size_px / side_px
        return scale / max(self.stretch.p95, 1.0)


def find_charts(
    vertices: np.ndarray,
    faces: np.ndarray,
    size_px: int,
    gutter_px: int,
    folder: Path,
    progress: Progress,
    atlases: int = 1,
    polygons: np.ndarray | None = None,
) -> Charts:
    """Cut the mesh into charts without folds with xatlas.

    Charts are found on a smoothed copy: on meshes as rough as real ones, xatlas makes up to twelve
    times as many. The charts are then relaxed to the shape of the mesh itself. If too much stretch
    remains, the mesh itself is charted too, and the result with the higher texel density is kept.

    Parameters
    ----------
    vertices : (v, 3) float64
        Median edge about 1, near the origin.
    faces : (f, 3) int32
        Faces with non-zero area.
    size_px, gutter_px : int
        Side of the texture and texels to keep free between charts.
    folder : Path
        For the files of the helper process.
    progress : Progress
        Span of this step.
    atlases : int
        Number of textures for the charts.
    polygons : (f,) int64, optional
        Polygon that each face is a part of. Charts cut none of them, but for folded ones with more
        than four sides.

    Raises
    ------
    WorkerError, DatasetError, ResourceError
        xatlas crashed, returned invalid results, took too long or got too little memory.
    """
    copy = smooth_vertices(vertices, faces)
    try:
        first = _charts(vertices, copy, faces, folder, progress.span(0.0, 0.6), polygons)
    except MemoryShortageError:
        raise
    except (WorkerError, ResourceError, DatasetError) as error:
        _logger.info("xatlas failed on the smoothed copy: %s", error.message)
        return _charts(vertices, vertices, faces, folder, progress.span(0.6, 1.0), polygons)
    too_stretched = (
        first.stretch.mean > MAX_MEAN_STRETCH or first.stretch.collapsed_share > MAX_LOST_SHARE
    )
    if not too_stretched and len(first.faces) == len(faces):
        return first
    second = _charts(vertices, vertices, faces, folder, progress.span(0.6, 1.0), polygons)
    density = [one.density(size_px, gutter_px, atlases) for one in (first, second)]
    _logger.debug("texels for an edge: %.2f, without smoothing %.2f", *density)
    lost = first.stretch.collapsed_share - second.stretch.collapsed_share
    lost += (len(second.faces) - len(first.faces)) / len(faces)
    return second if lost > MAX_LOST_SHARE or density[1] > MIN_DENSITY_GAIN * density[0] else first


def _charts(
    vertices: np.ndarray,
    positions: np.ndarray,
    faces: np.ndarray,
    folder: Path,
    progress: Progress,
    polygons: np.ndarray | None,
) -> Charts:
    """Cut the mesh into charts at given positions, and relax these to ``vertices``."""
    corner_uvs = _run_xatlas(positions, faces, folder, progress.span(0.0, 0.7))
    kept = np.flatnonzero(np.isfinite(corner_uvs).all(axis=(1, 2)))
    if len(kept) == 0:
        raise WorkerError("xatlas assigned no face to a chart.")
    faces, corner_uvs = faces[kept], corner_uvs[kept]
    graph = face_graph(vertices, faces)
    progress.update(0.75, "fitting charts to the surface")
    labels = uv_charts(graph, faces, corner_uvs)
    shapes = flatten_faces(vertices, faces)
    flat = equalise_density(_counter_clockwise(corner_uvs, labels), labels, shapes)
    if polygons is not None:
        polygons = polygons[kept]
        flat = join_polygons(flat, labels, faces, shapes, graph, polygons)
        labels = uv_charts(graph, faces, flat)
    flat = relax(flat, labels, shapes)
    progress.update(0.9, "splitting charts that fold")
    labels = split_overlaps(flat, labels, graph)
    if polygons is not None:
        flat, labels = set_cut_apart(flat, labels, faces, shapes, graph, polygons)
    flat = equalise_density(flat, labels, shapes)
    side = max(float(np.abs(flat).max()), 1e-300)
    stretch = texture_stretch(vertices, faces, flat / side)
    return Charts(kept, flat, labels, stretch, polygons)


def _counter_clockwise(corner_uvs: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Mirror the charts with negative total signed area."""
    uvs = np.asarray(corner_uvs, np.float64).copy()
    uvs[np.bincount(labels, signed_areas(uvs))[labels] < 0.0, :, 0] *= -1.0
    return uvs


def _run_xatlas(
    positions: np.ndarray, faces: np.ndarray, folder: Path, progress: Progress
) -> np.ndarray:
    """Return (f, 3, 2) float32, NaN for faces that xatlas ignored."""
    progress.update(0.0, "splitting the mesh for xatlas")
    labels = split_into_chunks(face_graph(positions, faces))
    order = np.argsort(labels, kind="stable")
    face_bounds = np.concatenate([[0], np.cumsum(np.bincount(labels))])
    vertices, local, vertex_bounds = [], [], [0]
    for begin, end in pairwise(face_bounds.tolist()):
        used, inverse = np.unique(faces[order[begin:end]], return_inverse=True)
        vertices.append(positions[used].astype(np.float32))
        local.append(inverse.reshape(-1, 3).astype(np.uint32))
        vertex_bounds.append(vertex_bounds[-1] + len(used))
    np.savez(
        folder / "input.npz",
        vertices=np.concatenate(vertices),
        corners=np.concatenate(local),
        vertex_bounds=np.array(vertex_bounds),
        face_bounds=face_bounds,
    )
    result = _run(CHARTS_HELPER, folder, len(faces), progress.span(0.1, 1.0))["corner_uvs"]
    if result.shape != (len(faces), 3, 2):
        raise WorkerError("xatlas returned UVs of another mesh.")
    corner_uvs = np.empty((len(faces), 3, 2), np.float32)
    corner_uvs[order] = result
    return corner_uvs


def _run(helper: str, folder: Path, faces: int, progress: Progress) -> dict[str, np.ndarray]:
    output = folder / "output.npz"
    output.unlink(missing_ok=True)
    run_helper(
        helper,
        folder,
        progress,
        deadline_s=DEADLINE_BASE_S + DEADLINE_PER_FACE_S * faces,
        memory_bytes=HELPER_MEMORY_BYTES,
    )
    with np.load(output, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def pack_charts(
    charts: Charts,
    size_px: int,
    gutter_px: int,
    folder: Path,
    progress: Progress,
    atlases: int = 1,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Pack charts into at most ``atlases`` unit squares, all at the same scale.

    Returns
    -------
    corner_uvs : (k, 3, 2) float32
        v upwards, no chart mirrored; NaN for faces that were not packed.
    face_atlas : (k,) uint8
        Square of each face.
    gutter_px : float
        Texels kept between charts; fewer than requested if there is no room.

    Raises
    ------
    WorkerError, DatasetError, ResourceError
        xatlas crashed, returned invalid results, took too long or got too little memory.
    """
    # Rows of a texture go down, v goes up: flipped here, so that charts keep their orientation.
    flat = (charts.corner_uvs * [1.0, -1.0]).astype(np.float32)
    labels = charts.labels
    if atlases > 1:
        labels = split_wide_charts(charts.corner_uvs, labels, atlases, charts.polygons)
    corners, first = chart_points(flat, labels)
    np.savez(
        folder / "input.npz",
        points=flat.reshape(-1, 2)[first],
        corners=corners.astype(np.uint32),
        charts=labels.astype(np.uint32),
        size_px=size_px,
        gutter_px=gutter_px,
        atlases=atlases,
    )
    output = _run(PACK_HELPER, folder, len(flat), progress)
    points, numbers = output["points"], output["atlas"]
    if points.shape != (len(first), 2) or numbers.shape != (len(first),):
        raise WorkerError("xatlas returned UVs of other charts.")
    corner_uvs = points[corners].astype(np.float32)
    corner_uvs[..., 1] = 1.0 - corner_uvs[..., 1]
    # All corners of a face are in one chart, and so in one atlas.
    return corner_uvs, numbers[corners[:, 0]].astype(np.uint8), float(output["gutter_px"])
