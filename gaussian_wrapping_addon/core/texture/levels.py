# SPDX-License-Identifier: GPL-3.0-or-later
"""Levels of detail: ever fewer faces, each level with an atlas and maps of its own.

Collapses across charts move the seams, so that one atlas for all levels would either forbid them
or smear colours. Each level is therefore unwrapped anew, at half the side, and looks its colours
up on the textured mesh by the same rays that find its normals on the dense one.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import MeshingError
from ..meshing.convex_region import Region
from ..meshing.decimation import decimate
from ..meshing.surface_mesh import SurfaceMesh
from ..progress import Progress
from ..settings import TextureSettings
from .atlas_raster import AtlasRaster, raster_atlas
from .dense_surface import BLOCK, NO_HIT, DenseSurface, cage_distance
from .detail import bake_detail
from .fill import fill_background, grow
from .sampling import pyramid
from .tangent_frame import shading_normals
from .texel_points import texel_points
from .texture_size import gutter_for
from .textured_mesh import TexturedMesh
from .unwrap import unwrap

_logger = logging.getLogger(__name__)

FACES_DIVISOR = 4
"""A level's faces are twice as long, so half the texture side shows as much a face."""
FLOOR_FACES = 100
"""No level below has fewer: a shape would not be known again."""
MIN_SIDE_PX = 128


class Colors(NamedTuple):
    """Where a level looks up its colours."""

    textured: TexturedMesh
    surface: DenseSurface
    """Of the textured mesh."""


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
        What level 0 was decimated from; otherwise level 0 is the dense mesh of the others.
    settings : TextureSettings
        ``lods`` levels are made, fewer where the next would have less than
        :data:`FLOOR_FACES` faces, or where no more faces can go without tearing the mesh.
    work_folder : Path
        For temporary sub-folders.
    region : Region, optional
        The region that the mesh was made in: its flat boundary stays flat.

    Returns
    -------
    list of TexturedMesh
        Levels 1, 2, ...
    """
    levels: list[TexturedMesh] = []
    if settings.lods == 0:
        return levels
    source = textured.mesh if dense is None else dense
    colors = Colors(textured, DenseSurface(textured.mesh))
    current, size_px = textured.mesh, textured.albedo.shape[0]
    for number in range(1, settings.lods + 1):
        span = progress.span((number - 1) / settings.lods, number / settings.lods)
        target = len(current.faces) // FACES_DIVISOR
        if target < FLOOR_FACES:
            _logger.info("level of detail %d would have %d faces: none is made", number, target)
            break
        try:
            fewer = decimate(
                current.vertices, current.faces, target, span.span(0.0, 0.2), region=region
            )
        except MeshingError as error:
            _logger.warning("no level of detail %d: %s", number, error.message)
            break
        if 2 * len(fewer.faces) > len(current.faces):
            _logger.warning("no level of detail %d: fewer faces would tear the mesh", number)
            break
        current = SurfaceMesh(fewer.vertices, fewer.faces.astype(np.int32))
        size_px = max(size_px // 2, min(size_px, MIN_SIDE_PX))
        levels.append(
            _level(current, colors, source, size_px, settings, work_folder, span, threads)
        )
    progress.update(1.0, f"{len(levels)} levels of detail")
    return levels


def _level(
    mesh: SurfaceMesh,
    colors: Colors,
    source: SurfaceMesh,
    size_px: int,
    settings: TextureSettings,
    work_folder: Path,
    progress: Progress,
    threads: int,
) -> TexturedMesh:
    gutter_px = gutter_for(size_px, settings.gutter_px)
    unwrapped = unwrap(
        mesh, size_px, gutter_px, work_folder, progress.span(0.2, 0.5), threads=threads
    )
    raster = raster_atlas(unwrapped.corner_uvs, size_px, threads)
    albedo = transferred(mesh, raster, colors, gutter_px, progress.span(0.5, 0.7))
    detail = bake_detail(
        mesh, unwrapped.corner_uvs, raster, source, settings, progress.span(0.7, 1.0),
        threads=threads,
    )  # fmt: skip
    statistics = {
        "faces": len(mesh.faces),
        "size_px": size_px,
        "unwrap": unwrapped.method,
        "texels_overlapping": raster.overlaps,
        **detail.statistics,
    }
    return TexturedMesh(
        mesh, unwrapped.corner_uvs, albedo, statistics, detail.normal_map, detail.occlusion
    )


def transferred(
    mesh: SurfaceMesh, raster: AtlasRaster, colors: Colors, gutter_px: int, progress: Progress
) -> np.ndarray:
    """Return the (h, w, 3) uint8 texture of a mesh, looked up on another textured one.

    Parameters
    ----------
    mesh : SurfaceMesh
    raster : AtlasRaster
        Of its UVs, at the size wanted: the source is averaged to the same fineness.
    gutter_px : int
    """
    size = raster.face.shape[0]
    cage = cage_distance(mesh, DenseSurface(mesh), colors.surface)
    level = max(0, round(math.log2(colors.textured.albedo.shape[0] / size)))
    levels = pyramid(colors.textured.albedo, level + 1)
    begin, width, height = levels.levels[min(level, len(levels.levels) - 1)].tolist()
    source = levels.pixels[begin : begin + width * height].reshape(height, width, 3)
    normals = shading_normals(mesh.vertices, mesh.faces)
    image = np.zeros((size, size, 3), np.uint8)
    texels = np.flatnonzero(raster.face.ravel() >= 0)
    for start in range(0, len(texels), BLOCK):
        progress.update(start / len(texels), "level of detail: colours")
        part = texels[start : start + BLOCK]
        at = texel_points(mesh, raster, part, normals)
        places = colors.surface.corresponding(at.points, at.normals, cage)
        lost = np.flatnonzero(places.how == NO_HIT)
        if len(lost):
            near, _ = colors.surface.nearest(at.points[lost])
            places.face[lost], places.weights[lost] = near.face, near.weights
        uvs = np.asarray(colors.textured.corner_uvs, np.float64)[places.face]  # (n, 3, 2)
        uv = np.einsum("nc,ncx->nx", places.weights, uvs)
        image.reshape(-1, 3)[part] = _looked_up(source, uv)
    owned = raster.face >= 0
    ring, chart = np.where(owned, 0, -1).astype(np.int16), np.where(owned, 0, -1).astype(np.int32)
    grow(image, ring, chart, gutter_px, inside=False)
    fill_background(image, ring >= 0)
    progress.update(1.0, "level of detail: colours")
    return image


def _looked_up(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear (n, 3) uint8 colours at (n, 2) UVs, v upwards."""
    height, width = image.shape[:2]
    x = (uv[:, 0] * width - 0.5).clip(0.0, width - 1.0)
    y = ((1.0 - uv[:, 1]) * height - 0.5).clip(0.0, height - 1.0)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (x - left)[:, None], (y - top)[:, None]
    upper = image[top, left] * (1.0 - across) + image[top, right] * across
    lower = image[below, left] * (1.0 - across) + image[below, right] * across
    return np.rint(upper * (1.0 - down) + lower * down).astype(np.uint8)
