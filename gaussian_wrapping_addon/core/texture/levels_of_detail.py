# SPDX-License-Identifier: GPL-3.0-or-later
"""Levels of detail, and the maps of each."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import MeshingError
from ..mesh.components import face_graph, uv_charts
from ..mesh.simplification import decimate
from ..mesh.surface_mesh import SurfaceMesh
from ..mesh.tangent_frame import shading_normals
from ..mesh.textured_mesh import AtlasMaps, TexturedMesh
from ..progress import Progress, ReportWarning
from ..regions.shapes import Region
from ..settings import TextureSettings
from .atlas import AtlasRaster, raster_atlas, texel_points
from .dense_detail import (
    BLOCK,
    MAX_SIDE_PX,
    NO_HIT,
    DenseSurface,
    DetailMap,
    bake_normal_map,
    bake_occlusion,
    cage_distance,
)
from .fill import fill_background, fill_gutters
from .size import gutter_for
from .unwrap.unwrap import Unwrap, unwrap

# -- Image pyramid of a texture whose averages never mix two charts -------------------------------


MIN_WEIGHT = 0.25
"""A look-up uses a level if this share of its four texels, by weight, belongs to the chart."""


@dataclass(frozen=True)
class ChartPyramid:
    """Levels of a texture, each of half the side; every texel has the colour of a single chart."""

    face_charts: np.ndarray
    """(f,) int32 chart of each face."""
    colors: list[np.ndarray]
    """(h, w, 3) of each level; the finest uint8, the others float32."""
    charts: list[np.ndarray]
    """(h, w) int32 of each level: the chart of the averaged texels, -1 for none."""

    def sample_level(self, uv: np.ndarray, face: np.ndarray, level: int) -> np.ndarray:
        """Return (n, 3) uint8 colours at UVs.

        Bilinear among texels of the face's chart; if a level has too few of them, as in charts
        narrower than its texels, the next finer one is used. The finest (0) uses all four texels:
        the gutter beyond a chart's border has its colours. UVs are (n, 2), v upwards.
        """
        charts = self.face_charts[face]
        result = np.zeros((len(uv), 3), np.uint8)
        left = np.arange(len(uv))
        for number in range(min(level, len(self.colors) - 1), -1, -1):
            color, weight = self._bilinear(uv[left], charts[left], number)
            good = weight >= MIN_WEIGHT if number else np.ones(len(left), np.bool_)
            result[left[good]] = np.rint(color[good])
            left = left[~good]
            if len(left) == 0:
                break
        return result

    def _bilinear(
        self, uv: np.ndarray, charts: np.ndarray, level: int
    ) -> tuple[np.ndarray, np.ndarray]:
        image, owner = self.colors[level], self.charts[level]
        height, width = owner.shape
        # Scale from the finest level: odd sides are rounded up by each halving.
        fine_height, fine_width = self.charts[0].shape
        x = (uv[:, 0] * fine_width / 2**level - 0.5).clip(0.0, width - 1.0)
        y = ((1.0 - uv[:, 1]) * fine_height / 2**level - 0.5).clip(0.0, height - 1.0)
        column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        across, down = x - column, y - row
        total, color = np.zeros(len(uv)), np.zeros((len(uv), 3))
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            at = np.minimum(row + dy, height - 1), np.minimum(column + dx, width - 1)
            weight = (across if dx else 1.0 - across) * (down if dy else 1.0 - down)
            if level:
                weight = weight * (owner[at] == charts)
            total += weight
            color += weight[:, None] * image[at]
        return color / np.maximum(total, 1e-12)[:, None], total


def chart_pyramid(
    textured: TexturedMesh, levels: int, threads: int, atlas: int = 0
) -> ChartPyramid:
    """Return the pyramid of one atlas, with at most ``levels`` in addition to the finest."""
    mesh, corner_uvs = textured.mesh, np.asarray(textured.corner_uvs)
    face_charts = uv_charts(face_graph(mesh.vertices, mesh.faces), mesh.faces, corner_uvs)
    albedo = textured.atlases[atlas].albedo
    raster = raster_atlas(corner_uvs, len(albedo), threads, textured.atlas_of_faces == atlas)
    owner = np.where(raster.face >= 0, face_charts[raster.face], -1).astype(np.int32)
    colors, charts = [albedo], [owner]
    weight = (owner >= 0).astype(np.float32)
    for _ in range(levels):
        if max(charts[-1].shape) == 1:
            break
        color, owner, weight = _halved(colors[-1], charts[-1], weight)
        colors.append(color)
        charts.append(owner)
    return ChartPyramid(face_charts, colors, charts)


def _halved(
    image: np.ndarray, owner: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average those of 2 x 2 texels in the chart that has most texels of the finest level there."""
    odd = ((0, owner.shape[0] % 2), (0, owner.shape[1] % 2))
    owner = np.pad(owner, odd, constant_values=-1)
    weight = np.pad(weight, odd)
    image = np.pad(image, (*odd, (0, 0)))
    offsets = [np.s_[dy::2, dx::2] for dy in (0, 1) for dx in (0, 1)]
    best = np.full(owner[offsets[0]].shape, -1, np.int32)
    most = np.zeros(best.shape, np.float32)
    for offset in offsets:
        support = sum(weight[p] * (owner[p] == owner[offset]) for p in offsets)
        better = support > most
        best[better], most[better] = owner[offset][better], support[better]
    color = np.zeros((*best.shape, 3), np.float32)
    for offset in offsets:
        color += (weight[offset] * (owner[offset] == best))[..., None] * image[offset]
    color /= np.maximum(most, 1.0)[..., None]
    return color, best, most


# -- Detail maps of a mesh from its dense version: normal map, ambient occlusion ------------------


DetailMaps = dict[str, DetailMap]
"""Maps in addition to the colours by the name of their statistics, as far as requested."""


def wants_normal_map(settings: TextureSettings, *, is_decimated: bool) -> bool:
    """Return whether a mesh gets a normal map."""
    return settings.normal_map == "on" or (settings.normal_map == "auto" and is_decimated)


def bake_detail(
    mesh: SurfaceMesh, unwrapped: Unwrap, raster: AtlasRaster, dense: SurfaceMesh | None,
    settings: TextureSettings, progress: Progress, *, threads: int, atlas: int,
) -> DetailMaps:  # fmt: skip
    """Bake the maps of one atlas of a mesh that the settings request.

    The normal map has the size of the raster of the atlas. Without the ``dense`` mesh before
    decimation, the mesh itself is the dense one.
    """
    with_normals = wants_normal_map(settings, is_decimated=dense is not None)
    with_occlusion = settings.ambient_occlusion == "on"
    if not (with_normals or with_occlusion):
        return {}
    maps: DetailMaps = {}
    surface = DenseSurface(mesh if dense is None else dense)
    size_px = raster.face.shape[0]
    if with_normals:
        gutter_px = gutter_for(size_px, settings.gutter_px)
        span = progress.span(0.0, 0.5 if with_occlusion else 1.0)
        maps["normal_map"] = bake_normal_map(
            mesh, unwrapped.corner_uvs, raster, surface, gutter_px, span
        )
    if with_occlusion:
        side_px = min(size_px, MAX_SIDE_PX)
        coarse = raster if side_px == size_px else unwrapped.raster(side_px, threads, atlas)
        gutter_px = gutter_for(side_px, settings.gutter_px)
        span = progress.span(0.5 if with_normals else 0.0, 1.0)
        maps["ambient_occlusion"] = bake_occlusion(mesh, coarse, surface, gutter_px, span)
    return maps


def images_of(maps: DetailMaps) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return normal map and occlusion, ``None`` where not requested."""
    found = (maps.get(name) for name in ("normal_map", "ambient_occlusion"))
    normal_map, occlusion = (None if one is None else one.image for one in found)
    return normal_map, occlusion


def merged_statistics(details: Sequence[DetailMaps]) -> dict[str, Any]:
    """Merge the statistics of the atlases of one mesh; shares are averaged."""
    merged: dict[str, Any] = {}
    for name, first in details[0].items():
        each = [detail[name].statistics for detail in details]
        merged[name] = {
            key: float(np.mean([one[key] for one in each])) if key.endswith("_share") else value
            for key, value in first.statistics.items()
        }
    return merged


# -- Levels of detail: successively decimated meshes, each with its own atlas and maps ------------
#
# Edge collapses across charts move the seams, so one atlas for all levels would either prevent
# them or smear colours. Each level is therefore unwrapped again, at half the side, and its
# colours are sampled from the textured mesh by the same rays that sample normals from the dense
# one.


_logger = logging.getLogger(__name__)

FACES_DIVISOR = 4
"""Edges of a level are twice as long, so half the texture side gives as many texels a face."""
FLOOR_FACES = 100
"""Minimum number of faces of a level; with fewer, the shape would not be recognisable."""
MIN_SIDE_PX = 128


class ColorSource(NamedTuple):
    """Source of the colours of a level."""

    textured: TexturedMesh
    surface: DenseSurface  # Surface of the textured mesh
    pyramids: list[ChartPyramid]  # Pyramids of its texture, one for each atlas


def levels_of_detail(
    textured: TexturedMesh, dense: SurfaceMesh | None, settings: TextureSettings,
    work_folder: Path, progress: Progress, *, threads: int, region: Region | None = None,
) -> list[TexturedMesh]:  # fmt: skip
    """Make the coarser levels 1, 2, ... of a textured mesh, which is level 0.

    Parameters
    ----------
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
        coarser = _coarser(current, span.span(0.0, 0.2), region)
        if isinstance(coarser, str):
            text = f"{number - 1} of {settings.lods} levels of detail were made: {coarser}."
            _logger.warning("%s", text)
            hint = "Choose fewer with --set lods=N, or a mesh with more faces."
            warning = ReportWarning("fewer-levels", text, hint)
            textured.statistics.setdefault("warnings", []).append(warning.to_json())
            break
        current = coarser
        size_px = max(size_px // 2, min(size_px, MIN_SIDE_PX))
        levels.append(
            _level(current, colors, source, size_px, settings, work_folder, span, threads)
        )
    progress.update(1.0, f"{len(levels)} levels of detail")
    return levels


def _coarser(mesh: SurfaceMesh, progress: Progress, region: Region | None) -> SurfaceMesh | str:
    """Return the decimated mesh of the next level, or why there is none."""
    target = len(mesh.faces) // FACES_DIVISOR
    if target < FLOOR_FACES:
        return f"the next would have {target} faces"
    try:
        fewer = decimate(mesh.vertices, mesh.faces, target, progress, region=region)
    except MeshingError as error:
        return error.message.rstrip(".")
    if 2 * len(fewer.faces) > len(mesh.faces):
        return "fewer faces would tear the mesh"
    return SurfaceMesh(fewer.vertices, fewer.faces.astype(np.int32))


def _level(
    mesh: SurfaceMesh, colors: ColorSource, source: SurfaceMesh, size_px: int,
    settings: TextureSettings, work_folder: Path, progress: Progress, threads: int,
) -> TexturedMesh:  # fmt: skip
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
        maps.append(AtlasMaps(albedo, *images_of(detail)))
    statistics = {
        "faces": len(mesh.faces), "size_px": size_px, "atlases": unwrapped.atlases,
        "unwrap": unwrapped.method, "texels_overlapping": overlaps, **merged_statistics(details),
    }  # fmt: skip
    return TexturedMesh.of(mesh, unwrapped.corner_uvs, unwrapped.face_atlas, maps, statistics)


def transfer_colors(
    mesh: SurfaceMesh, raster: AtlasRaster, colors: ColorSource, gutter_px: int, progress: Progress
) -> np.ndarray:
    """Return the (h, w, 3) uint8 texture of a mesh, sampled from another textured mesh.

    The raster of its UVs has the wanted size; the source is averaged to the same resolution, within
    its charts.
    """
    size = raster.face.shape[0]
    cage = cage_distance(mesh, colors.surface)
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
    fill_background(image, fill_gutters(image, raster.face >= 0, gutter_px))
    progress.update(1.0, "level of detail: colours")
    return image
