# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture a mesh from photos: unwrap, bake, fill unseen texels, coverage statistics."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np

from .. import limits
from ..errors import MeshingError, UsageError
from ..mesh.components import FaceGraph, face_graph
from ..mesh.surface_mesh import SurfaceMesh, area_vectors
from ..mesh.textured_mesh import AtlasMaps, TexturedMesh
from ..progress import Progress, ReportWarning
from ..scene.scene import PhotoSource, Scene
from ..settings import TextureSettings
from .atlas import AtlasRaster
from .atlas_colors import MAX_FILL_SOURCES, AtlasColors, fill_harmonically
from .bake import (
    CoverageStatistics,
    atlas_points,
    bake,
    blocks_of,
    correction_sample_count,
    prepare_photos,
)
from .levels_of_detail import bake_detail, images_of, merged_statistics, wants_normal_map
from .photo_samples import SurfaceArrays, SurfacePoints
from .size import EXPECTED_UTILISATION, fit_into_memory, gutter_for, plan_textures, required_side
from .unwrap.charts import texture_stretch
from .unwrap.unwrap import Unwrap, unwrap, uv_area

_logger = logging.getLogger(__name__)

MIN_UV_AREA = 1e-4
"""Smallest area of existing UVs for which the size of a texture is derived."""


def texture_mesh(
    mesh: SurfaceMesh, scene: Scene, photos: PhotoSource, settings: TextureSettings,
    work_folder: Path, progress: Progress, *, threads: int, dense: SurfaceMesh | None = None,
    free_bytes: int = 0, unwrapped: Unwrap | None = None, polygons: np.ndarray | None = None,
) -> TexturedMesh:  # fmt: skip
    """Unwrap a mesh of the scene frame and bake its texture (docs/method.md, section 8).

    Parameters
    ----------
    settings : TextureSettings
        ``size_px = 0`` chooses the size from the photos' footprint, ``max_atlases = 0`` the number
        of textures.
    work_folder : Path
        For a temporary sub-folder of the unwrap.
    threads : int
        The result does not depend on it.
    dense : SurfaceMesh, optional
        The mesh before decimation; its detail goes into the normal map.
    free_bytes : int
        Available memory; 0 if unknown, then memory is not checked.
    unwrapped : Unwrap, optional
        Existing UVs to keep.
    polygons : (f,) int64, optional
        Polygon that each face is a part of, for new UVs: see :func:`.unwrap.unwrap`.

    Raises
    ------
    MeshingError
        The mesh has no face with area, a vertex that is not finite, or an index out of range.
    UsageError
        The size is out of range.
    ResourceError
        A texture of the requested size needs more memory than is available.
    """
    validate_for_texturing(mesh)
    if settings.size_px < 0 or settings.size_px > limits.MAX_TEXTURE_SIDE_PX:
        raise UsageError(
            f"A texture of {settings.size_px} pixels is out of range.",
            f"Give 0 (automatic) or up to {limits.MAX_TEXTURE_SIDE_PX}.",
        )
    graph = face_graph(mesh.vertices, mesh.faces)
    count = len(scene.views)
    size_px, atlases, warning = _plan(graph, photos, count, settings, dense, free_bytes, unwrapped)
    gutter_px = gutter_for(size_px, settings.gutter_px)
    if unwrapped is None:
        progress.update(0.0, f"unwrapping for {atlases} x {size_px} x {size_px} texels")
        unwrapped = unwrap(
            mesh, size_px, gutter_px, work_folder, progress.span(0.0, 0.3),
            threads=threads, atlases=atlases, polygons=polygons,
        )  # fmt: skip
    atlases = unwrapped.atlases
    surface, sample, first = _sample_surface(mesh, graph, unwrapped, size_px, count, threads)
    preparation = prepare_photos(
        sample, surface, photos, count, progress.span(0.3, 0.42), threads=threads
    )
    coverage = CoverageStatistics(len(mesh.faces))
    colors, details, views = [], [], []
    for number in range(atlases):
        span = progress.span(0.42 + 0.48 * number / atlases, 0.42 + 0.48 * (number + 1) / atlases)
        raster = unwrapped.raster(size_px, threads, number) if first is None else first
        detail = bake_detail(
            mesh, unwrapped, raster, dense, settings, span.span(0.0, 0.2),
            threads=threads, atlas=number,
        )  # fmt: skip
        details.append(detail)
        overlaps, atlas = raster.overlaps, atlas_points(raster, unwrapped.charts)
        del raster
        first = None  # half of the memory
        baked = bake(
            atlas.points, surface, photos, preparation, span.span(0.2, 1.0), threads=threads
        )
        coverage.add(atlas.points, baked, overlaps)
        shown = np.zeros((size_px, size_px), np.uint8)
        for rows in blocks_of(len(atlas.texels)):
            shown.reshape(-1)[atlas.texels[rows]] = baked.views[rows]
        views.append(shown)
        colors.append(AtlasColors(atlas, baked, MAX_FILL_SOURCES // atlases, surface))
        del atlas, baked
    progress.update(0.9, "filling unseen texels")
    fill = fill_harmonically(colors, surface)
    images = []
    while colors:  # frees each
        images.append(colors.pop(0).finish(fill, surface, gutter_px))
    stretch = texture_stretch(mesh.vertices, mesh.faces, unwrapped.corner_uvs)
    statistics = {
        **coverage.statistics(size_px, settings, unwrapped, graph.areas),
        **preparation.statistics,
        "stretch_mean": stretch.mean,
        "stretch_p95": stretch.p95,
        "area_collapsed_share": stretch.collapsed_share,
        "warnings": [] if warning is None else [warning.to_json()],
        **merged_statistics(details),
    }
    if statistics["texels_seen"] == 0:
        _logger.warning("no photo sees the mesh: its texture is plain grey")
    progress.update(1.0, f"texture: {100 * statistics['coverage']:.1f} % seen by photos")
    maps = [
        AtlasMaps(image, *images_of(detail), shown)
        for image, detail, shown in zip(images, details, views, strict=True)
    ]
    return TexturedMesh.of(mesh, unwrapped.corner_uvs, unwrapped.face_atlas, maps, statistics)


def _plan(
    graph: FaceGraph, photos: PhotoSource, count: int, settings: TextureSettings,
    dense: SurfaceMesh | None, free_bytes: int, unwrapped: Unwrap | None,
) -> tuple[int, int, ReportWarning | None]:  # fmt: skip
    """Return side and number of textures, and a warning if memory limits them."""
    detail_points = 0
    if dense is not None and wants_normal_map(settings, is_decimated=True):
        detail_points = len(dense.vertices)
    wanted = required_side(graph, photos, count, detail_points)
    if unwrapped is None:
        size_px, atlases = plan_textures(wanted, settings.size_px, settings.max_atlases)
    else:
        wanted *= math.sqrt(EXPECTED_UTILISATION / max(uv_area(unwrapped.corner_uvs), MIN_UV_AREA))
        size_px, atlases = plan_textures(wanted, settings.size_px, 1)[0], unwrapped.atlases
    size_px, atlases, warning = fit_into_memory(
        size_px, atlases, len(graph.areas), free_bytes, may_lower=settings.size_px == 0,
        may_join=unwrapped is None,
    )  # fmt: skip
    if warning is not None:
        _logger.warning("%s", warning.text)
    return size_px, atlases, warning


def _sample_surface(
    mesh: SurfaceMesh, graph: FaceGraph, unwrapped: Unwrap, size_px: int, photos: int, threads: int
) -> tuple[SurfaceArrays, SurfacePoints, AtlasRaster | None]:
    """Return the surface with its texel size, evenly spread points, and the raster if only one.

    Several rasters would take too much memory: they are computed again when needed.
    """
    wanted, inside = correction_sample_count(photos), 0
    samples, counts = [], []
    raster = None
    for number in range(unwrapped.atlases):
        raster = unwrapped.raster(size_px, threads, number)
        inside += int(raster.inside.sum())
        used = int(np.count_nonzero(raster.face >= 0))
        counts.append(used)
        samples.append(_even_texels(raster, used, min(wanted, used)))
    texel_size = math.sqrt(float(graph.areas.sum()) / max(inside, 1))
    surface = SurfaceArrays.of(mesh.vertices, mesh.faces, graph.normals, texel_size)
    if len(samples) == 1:
        return surface, samples[0], raster
    parts = []
    for used, sample in zip(counts, samples, strict=True):
        share = min(len(sample), max(1, round(wanted * used / max(sum(counts), 1))))
        parts.append(sample.part(np.linspace(0, len(sample) - 1, share).astype(np.int64)))
    face, bary = (np.concatenate([getattr(p, n) for p in parts]) for n in ("face", "bary"))
    return surface, SurfacePoints(face, bary), None


def _even_texels(raster: AtlasRaster, used: int, wanted: int) -> SurfacePoints:
    """Return ``wanted`` of the ``used`` texels with a face, evenly spaced in their order."""
    rank = np.linspace(0, used - 1, wanted).astype(np.int64)
    ends = np.cumsum((raster.face >= 0).sum(axis=1))
    row = np.searchsorted(ends, rank, side="right")
    column = np.empty(wanted, np.int64)
    for y in np.unique(row).tolist():
        owned = np.flatnonzero(raster.face[y] >= 0)
        mine = row == y
        column[mine] = owned[rank[mine] - (ends[y] - len(owned))]
    return SurfacePoints(raster.face[row, column], raster.bary[row, column])


def validate_for_texturing(mesh: SurfaceMesh) -> None:
    """Raise ``MeshingError`` if a mesh cannot be unwrapped or written."""
    hint = "Mesh the region again, or send the job folder's log.txt with a bug report."
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if len(faces) == 0 or len(vertices) == 0:
        raise MeshingError("The mesh has no faces.", "Choose a region that holds a surface.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshingError("A face of the mesh refers to a vertex that does not exist.", hint)
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        text = f"{int((~finite).sum())} vertices of the mesh are not finite, the first is "
        raise MeshingError(f"{text}{int(np.argmin(finite))}.", hint)
    cross = area_vectors(vertices.astype(np.float64), faces)
    if not (np.abs(cross).max() > 0 and np.isfinite(cross).all()):
        raise MeshingError("No face of the mesh has an area.", hint)
