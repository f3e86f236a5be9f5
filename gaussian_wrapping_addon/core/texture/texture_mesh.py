# SPDX-License-Identifier: GPL-3.0-or-later
"""From a mesh and photos to a textured mesh: unwrap, bake, fill, count."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np

from .. import limits
from ..dataset.scene import Scene
from ..errors import MeshingError, UsageError
from ..meshing.surface_mesh import SurfaceMesh
from ..progress import Progress
from ..settings import TextureSettings
from .atlas_raster import AtlasRaster, raster_atlas
from .bake import Baked, Photos, bake
from .detail import bake_detail, wants_normal_map
from .face_graph import face_graph
from .fill import (
    RING_TEXELS,
    continue_over_surface,
    fill_background,
    grow,
    surface_positions,
)
from .photo_samples import SurfaceArrays, SurfacePoints
from .stretch import texture_stretch
from .texture_size import automatic_size, gutter_for
from .textured_mesh import TexturedMesh
from .unwrap import Unwrap, unwrap

_logger = logging.getLogger(__name__)

CONTINUED_POINTS = 1_000_000
"""As many seen texels are enough for the cells from which colours are continued."""
OUTLINE_TEXELS = 8
"""Texels seen only at silhouettes take their neighbours' colour within this distance."""


UNSURE_LEVELS = 15.0
"""What only grazing or half hidden views show is taken while it is this near to what lies around,
and not at all at twice this: on trained meshes such views are often of something before it."""


def texture_mesh(
    mesh: SurfaceMesh,
    scene: Scene,
    photos: Photos,
    settings: TextureSettings,
    work_folder: Path,
    progress: Progress,
    *,
    threads: int,
    dense: SurfaceMesh | None = None,
) -> TexturedMesh:
    """Unwrap a mesh and bake its texture from the photos (method.md 8).

    Parameters
    ----------
    mesh : SurfaceMesh
        In the scene frame.
    scene : Scene
        Whose views the photos are.
    photos : PhotoStore
        Anything with ``camera``, ``photo`` and ``mask`` by index and divisor.
    settings : TextureSettings
        ``size_px = 0`` chooses the size from the photos' footprint.
    work_folder : Path
        For a temporary sub-folder of the unwrap.
    progress : Progress
        Span of this step.
    threads : int
        Threads to use; the result does not depend on it.
    dense : SurfaceMesh, optional
        What the mesh was decimated from: its detail goes into the normal map.

    Raises
    ------
    MeshingError
        The mesh has no face with area, a vertex that is not finite, or an index out of range.
    UsageError
        The size is out of range.
    """
    check_mesh(mesh)
    if settings.size_px < 0 or settings.size_px > limits.MAX_TEXTURE_SIDE_PX:
        raise UsageError(
            f"A texture of {settings.size_px} pixels is out of range.",
            f"Give 0 (automatic) or up to {limits.MAX_TEXTURE_SIDE_PX}.",
        )
    graph = face_graph(mesh.vertices, mesh.faces)
    count = len(scene.views)
    detail_points = 0
    if dense is not None and wants_normal_map(settings, is_decimated=True):
        detail_points = len(dense.vertices)
    size_px = settings.size_px or automatic_size(graph, photos, count, detail_points)
    progress.update(0.0, f"unwrapping for {size_px} x {size_px} texels")
    gutter_px = gutter_for(size_px, settings.gutter_px)
    unwrapped = unwrap(
        mesh, size_px, gutter_px, work_folder, progress.span(0.0, 0.3), threads=threads
    )
    raster = raster_atlas(unwrapped.corner_uvs, size_px, threads)
    texels = np.flatnonzero(raster.face.ravel() >= 0)
    points = SurfacePoints(
        raster.face.ravel()[texels], raster.bary.reshape(-1, 2)[texels].astype(np.float32)
    )
    texel_size = math.sqrt(float(graph.areas.sum()) / max(int(raster.inside.sum()), 1))
    surface = SurfaceArrays.of(
        np.ascontiguousarray(mesh.vertices, np.float64),
        np.ascontiguousarray(mesh.faces, np.int32),
        graph.normals,
        texel_size,
    )
    baked = bake(points, surface, photos, count, progress.span(0.3, 0.8), threads=threads)
    detail = bake_detail(
        mesh, unwrapped.corner_uvs, raster, dense, settings, progress.span(0.8, 0.9),
        threads=threads,
    )  # fmt: skip
    progress.update(0.9, "filling what no photo saw")
    albedo = _image(size_px, texels, points, surface, baked, raster, unwrapped, gutter_px)
    stretch = texture_stretch(mesh.vertices, mesh.faces, unwrapped.corner_uvs)
    statistics = {
        **_statistics(size_px, settings, unwrapped, raster, points, baked, graph.areas),
        "stretch_mean": stretch.mean,
        "stretch_p95": stretch.p95,
        "area_collapsed_share": stretch.collapsed_share,
        **detail.statistics,
    }
    if statistics["texels_seen"] == 0:
        _logger.warning("no photo sees the mesh: its texture is plain grey")
    progress.update(1.0, f"texture: {100 * statistics['coverage']:.1f} % seen by photos")
    views = np.zeros((size_px, size_px), np.uint8)
    views.ravel()[texels] = baked.views
    return TexturedMesh(
        mesh, unwrapped.corner_uvs, albedo, statistics, detail.normal_map, detail.occlusion, views
    )


def check_mesh(mesh: SurfaceMesh) -> None:
    """Refuse what cannot be unwrapped or written (conventions.md D.5, 46 and 49)."""
    hint = "Mesh the region again, or send the job folder's log.txt with a bug report."
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if len(faces) == 0 or len(vertices) == 0:
        raise MeshingError("The mesh has no faces.", "Choose a region that holds a surface.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshingError("A face of the mesh names a vertex that does not exist.", hint)
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        first = int(np.flatnonzero(~finite)[0])
        raise MeshingError(
            f"{int((~finite).sum())} vertices of the mesh are not finite, the first is {first}.",
            hint,
        )
    corners = vertices[faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if not (np.abs(cross).max() > 0 and np.isfinite(cross).all()):
        raise MeshingError("No face of the mesh has an area.", hint)


def _image(
    size_px: int,
    texels: np.ndarray,
    points: SurfacePoints,
    surface: SurfaceArrays,
    baked: Baked,
    raster: AtlasRaster,
    unwrapped: Unwrap,
    gutter_px: int,
) -> np.ndarray:
    """Put the colours into the image; fill unseen texels, gutters and the rest."""
    seen = baked.sure
    image = np.zeros((size_px, size_px, 3), np.uint8)
    pixels = image.reshape(-1, 3)
    pixels[texels] = baked.colors
    chart = np.where(raster.face >= 0, unwrapped.charts[raster.face], -1).astype(np.int32)
    ring = np.full((size_px, size_px), -1, np.int16)
    flat_ring = ring.ravel()
    # Seen at silhouettes only: the neighbours' colour is cleaner, where there are neighbours.
    clear = seen & baked.clear
    flat_ring[texels[clear]] = 0
    grow(image, ring, chart, OUTLINE_TEXELS, inside=True)
    trusted = seen & (flat_ring[texels] >= 0)
    trusted = trusted if trusted.any() else seen
    flat_ring[texels[~seen]] = -1
    flat_ring[texels[seen]] = 0
    if not seen.all():
        grow(image, ring, chart, RING_TEXELS, inside=True)
        unseen = texels[~seen]
        known = np.flatnonzero(trusted)
        known = known[:: max(1, len(known) // CONTINUED_POINTS)]
        far = continue_over_surface(
            surface_positions(points.part(known), surface),
            pixels[texels[known]],
            surface_positions(points.part(~seen), surface),
        )
        number = flat_ring[unseen].astype(np.float32)
        share = np.where(number < 0, 1.0, number / (RING_TEXELS + 1.0))[:, None]
        near = pixels[unseen]
        pixels[unseen] = np.rint(near + share * (far - near)).astype(np.uint8)
    unsure = np.flatnonzero((baked.views > 0) & ~seen)
    around, shown = pixels[texels[unsure]].astype(np.float32), baked.colors[unsure]
    off = np.abs(shown - around).max(axis=1, initial=0.0)
    number = flat_ring[texels[unsure]].astype(np.float32)
    away = np.where(number < 0, 1.0, number / (RING_TEXELS + 1.0))  # no step at the sure ones
    share = (away * (2.0 - off / UNSURE_LEVELS).clip(0.0, 1.0))[:, None]
    pixels[texels[unsure]] = np.rint(around + share * (shown - around)).astype(np.uint8)
    flat_ring[texels] = 0
    grow(image, ring, chart, gutter_px, inside=False)
    fill_background(image, ring >= 0)
    return image


def _statistics(
    size_px: int,
    settings: TextureSettings,
    unwrapped: Unwrap,
    raster: AtlasRaster,
    points: SurfacePoints,
    baked: Baked,
    areas: np.ndarray,
) -> dict[str, Any]:
    seen = baked.views > 0
    with_texel = np.zeros(len(areas), np.bool_)
    with_texel[points.face] = True
    face_seen = np.zeros(len(areas), np.bool_)
    face_seen[points.face[seen]] = True
    used, texels_seen = len(points), int(seen.sum())
    judged_area = float(areas[with_texel].sum())
    return {
        "size_px": size_px,
        "size_automatic": settings.size_px == 0,
        "unwrap": unwrapped.method,
        "unwrap_fallback_reason": unwrapped.reason,
        "charts": int(unwrapped.charts.max()) + 1,
        "gutter_px": round(unwrapped.gutter_px, 2),
        "utilisation": used / size_px**2,
        "texels_used": used,
        "texels_seen": texels_seen,
        "texels_filled": used - texels_seen,
        "texels_seen_at_outlines_only": int((baked.sure & ~baked.clear).sum()),
        "texels_seen_badly": int((seen & ~baked.sure).sum()),
        "texels_overlapping": raster.overlaps,
        "coverage": texels_seen / max(used, 1),
        "faces_seen_share": float(face_seen.sum()) / max(int(with_texel.sum()), 1),
        # Of the faces that have a texel: whether a photo saw the others is not known.
        "area_seen_share": float(areas[face_seen].sum()) / judged_area if judged_area else 0.0,
        "area_without_texel_share": float(areas[~with_texel].sum() / areas.sum()),
        "faces_without_texel": int((~with_texel).sum()),
        "views_per_seen_texel": float(baked.views[seen].mean()) if texels_seen else 0.0,
        "views_rejected_share": baked.rejected_share,
        "photos_used": baked.photos_used,
        "exposure_spread": baked.gain_spread,
        "exposure_corrected": baked.gains_applied,
        "brightness_spread_within_photos": baked.field_spread,
        "brightness_evened_within_photos": baked.fields_applied,
    }
