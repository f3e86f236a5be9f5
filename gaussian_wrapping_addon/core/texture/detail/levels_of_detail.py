# SPDX-License-Identifier: GPL-3.0-or-later
"""Levels of detail: successively decimated meshes, each with its own atlas and maps.

Edge collapses across charts move the seams, so one atlas for all levels would either prevent them
or smear colours. Each level is therefore unwrapped again, at half the side, and its colours are
sampled from the textured mesh by the same rays that sample normals from the dense one.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import MeshingError
from ...mesh.simplification.decimation import decimate
from ...mesh.surface_mesh import SurfaceMesh
from ...mesh.tangent_frame import shading_normals
from ...mesh.textured_mesh import AtlasMaps, TexturedMesh
from ...progress import Progress
from ...regions.convex_region import Region
from ...report_warning import ReportWarning
from ...settings import TextureSettings
from ..atlas.atlas_raster import AtlasRaster
from ..atlas.texel_points import texel_points
from ..bake.fill import dilate, fill_background
from ..cost.texture_size import gutter_for
from ..unwrap.unwrap import unwrap
from .chart_pyramid import ChartPyramid, chart_pyramid
from .dense_surface import BLOCK, NO_HIT, DenseSurface, cage_distance
from .detail import bake_detail, merged_statistics

_logger = logging.getLogger(__name__)

FACES_DIVISOR = 4
"""Edges of a level are twice as long, so half the texture side gives as many texels a face."""
FLOOR_FACES = 100
"""Minimum number of faces of a level; with fewer, the shape would not be recognisable."""
MIN_SIDE_PX = 128


class ColorSource(NamedTuple):
    """Source of the colours of a level."""

    textured: TexturedMesh
    surface: DenseSurface
    """Surface of the textured mesh."""
    pyramids: list[ChartPyramid]
    """Pyramids of its texture, one for each atlas."""


def levels_of_detail(
    textured: TexturedMesh,
    dense: SurfaceMesh | None,
    settings: TextureSettings,
    work_folder: Path,
    progress: Progress,
    *,
    threads: int,
    region: Region | None = None,
) -> list[TexturedMesh]:
    """Make the coarser levels of a textured mesh.

    Parameters
    ----------
    textured : TexturedMesh
        Level 0.
    dense : SurfaceMesh or None
        Level 0 before decimation; without one, level 0 is the dense mesh of the others.
    settings : TextureSettings
        ``lods`` levels are made, fewer if the next would have less than :data:`FLOOR_FACES` faces,
        or if no more faces can be removed without tearing the mesh. The reason is added to
        ``warnings`` in the statistics of ``textured``.
    work_folder : Path
        For temporary sub-folders.
    region : Region, optional
        Region of the mesh: its flat boundary stays flat.

    Returns
    -------
    list of TexturedMesh
        Levels 1, 2, ...
    """
    levels: list[TexturedMesh] = []
    if settings.lods == 0:
        return levels
    source = textured.mesh if dense is None else dense
    pyramids = [
        chart_pyramid(textured, settings.lods, threads, number)
        for number in range(len(textured.atlases))
    ]
    colors = ColorSource(textured, DenseSurface(textured.mesh), pyramids)
    current, size_px = textured.mesh, textured.albedo.shape[0]
    for number in range(1, settings.lods + 1):
        span = progress.span((number - 1) / settings.lods, number / settings.lods)
        target = len(current.faces) // FACES_DIVISOR
        if target < FLOOR_FACES:
            _warn_fewer_levels(textured, settings, number, f"the next would have {target} faces")
            break
        try:
            fewer = decimate(
                current.vertices, current.faces, target, span.span(0.0, 0.2), region=region
            )
        except MeshingError as error:
            _warn_fewer_levels(textured, settings, number, error.message.rstrip("."))
            break
        if 2 * len(fewer.faces) > len(current.faces):
            _warn_fewer_levels(textured, settings, number, "fewer faces would tear the mesh")
            break
        current = SurfaceMesh(fewer.vertices, fewer.faces.astype(np.int32))
        size_px = max(size_px // 2, min(size_px, MIN_SIDE_PX))
        levels.append(
            _level(current, colors, source, size_px, settings, work_folder, span, threads)
        )
    progress.update(1.0, f"{len(levels)} levels of detail")
    return levels


def _warn_fewer_levels(
    textured: TexturedMesh, settings: TextureSettings, number: int, reason: str
) -> None:
    """Log and report why there is no further level."""
    text = f"{number - 1} of {settings.lods} levels of detail were made: {reason}."
    _logger.warning("%s", text)
    hint = "Choose fewer with --lods, or a mesh with more faces."
    warning = ReportWarning("fewer-levels", text, hint)
    textured.statistics.setdefault("warnings", []).append(warning.to_json())


def _level(
    mesh: SurfaceMesh,
    colors: ColorSource,
    source: SurfaceMesh,
    size_px: int,
    settings: TextureSettings,
    work_folder: Path,
    progress: Progress,
    threads: int,
) -> TexturedMesh:
    gutter_px = gutter_for(size_px, settings.gutter_px)
    unwrapped = unwrap(
        mesh, size_px, gutter_px, work_folder, progress.span(0.2, 0.5),
        threads=threads, atlases=len(colors.textured.atlases),
    )  # fmt: skip
    maps, details, overlaps = [], [], 0
    for number in range(unwrapped.atlases):
        low, high = (0.5 + 0.5 * n / unwrapped.atlases for n in (number, number + 1))
        span = progress.span(low, high)
        raster = unwrapped.raster(size_px, threads, number)
        overlaps += raster.overlaps
        albedo = transfer_colors(mesh, raster, colors, gutter_px, span.span(0.0, 0.4))
        detail = bake_detail(
            mesh, unwrapped, raster, source, settings, span.span(0.4, 1.0),
            threads=threads, atlas=number,
        )  # fmt: skip
        details.append(detail)
        maps.append(AtlasMaps(albedo, detail.normal_map, detail.occlusion))
    statistics = {
        "faces": len(mesh.faces),
        "size_px": size_px,
        "atlases": unwrapped.atlases,
        "unwrap": unwrapped.method,
        "texels_overlapping": overlaps,
        **merged_statistics(details),
    }
    return TexturedMesh.of(mesh, unwrapped.corner_uvs, unwrapped.face_atlas, maps, statistics)


def transfer_colors(
    mesh: SurfaceMesh, raster: AtlasRaster, colors: ColorSource, gutter_px: int, progress: Progress
) -> np.ndarray:
    """Return the (h, w, 3) uint8 texture of a mesh, sampled from another textured mesh.

    Parameters
    ----------
    mesh : SurfaceMesh
    raster : AtlasRaster
        Raster of its UVs at the wanted size; the source is averaged to the same resolution,
        within its charts.
    gutter_px : int
    """
    size = raster.face.shape[0]
    cage = cage_distance(mesh, DenseSurface(mesh), colors.surface)
    level = max(0, round(math.log2(colors.textured.albedo.shape[0] / size)))
    atlas_of_faces = colors.textured.atlas_of_faces
    normals = shading_normals(mesh.vertices, mesh.faces)
    image = np.zeros((size, size, 3), np.uint8)
    texels = np.flatnonzero(raster.face.ravel() >= 0)
    for start in range(0, len(texels), BLOCK):
        progress.update(start / len(texels), "level of detail: colours")
        part = texels[start : start + BLOCK]
        at = texel_points(mesh, raster, part, normals)
        matches = colors.surface.correspondences(at.points, at.normals, cage)
        lost = np.flatnonzero(matches.method == NO_HIT)
        if len(lost):
            near, _ = colors.surface.nearest(at.points[lost])
            matches.face[lost], matches.weights[lost] = near.face, near.weights
        uvs = np.asarray(colors.textured.corner_uvs, np.float64)[matches.face]  # (n, 3, 2)
        uv = np.einsum("nc,ncx->nx", matches.weights, uvs)
        owner = atlas_of_faces[matches.face]
        for number, pyramid in enumerate(colors.pyramids):
            mine = owner == number
            found = pyramid.sample_level(uv[mine], matches.face[mine], level)
            image.reshape(-1, 3)[part[mine]] = found
    owned = raster.face >= 0
    ring, chart = np.where(owned, 0, -1).astype(np.int16), np.where(owned, 0, -1).astype(np.int32)
    dilate(image, ring, chart, gutter_px, inside=False)
    fill_background(image, ring >= 0)
    progress.update(1.0, "level of detail: colours")
    return image
