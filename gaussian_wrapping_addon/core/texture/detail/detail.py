# SPDX-License-Identifier: GPL-3.0-or-later
"""Detail maps of a mesh from its dense version: normal map, ambient occlusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...mesh.surface_mesh import SurfaceMesh
from ...progress import Progress
from ...settings import TextureSettings
from ..atlas.atlas_raster import AtlasRaster
from ..cost.texture_size import gutter_for
from ..unwrap.unwrap import Unwrap
from .dense_surface import DenseSurface
from .normal_map import bake_normal_map
from .occlusion import MAX_SIDE_PX, bake_occlusion


@dataclass(frozen=True)
class DetailMaps:
    """Maps in addition to the colours; ``None`` if not requested."""

    normal_map: np.ndarray | None = None
    """(h, w, 3) uint8."""
    occlusion: np.ndarray | None = None
    """(k, k) uint8."""
    statistics: dict[str, Any] = field(default_factory=dict)


def wants_normal_map(settings: TextureSettings, *, is_decimated: bool) -> bool:
    """Return whether a mesh gets a normal map."""
    return settings.normal_map == "on" or (settings.normal_map == "auto" and is_decimated)


def bake_detail(
    mesh: SurfaceMesh,
    unwrapped: Unwrap,
    raster: AtlasRaster,
    dense: SurfaceMesh | None,
    settings: TextureSettings,
    progress: Progress,
    *,
    threads: int,
    atlas: int = 0,
) -> DetailMaps:
    """Bake the maps requested by the settings.

    Parameters
    ----------
    mesh : SurfaceMesh
        The mesh that uses the maps.
    unwrapped : Unwrap
    raster : AtlasRaster
        Raster of the baked atlas; the normal map has its size.
    dense : SurfaceMesh or None
        The mesh before decimation; without one, the mesh itself is the dense mesh.
    settings : TextureSettings
    progress : Progress
        Span of this step.
    atlas : int
        Number of the atlas.
    """
    with_normals = wants_normal_map(settings, is_decimated=dense is not None)
    with_occlusion = settings.ambient_occlusion == "on"
    if not (with_normals or with_occlusion):
        return DetailMaps()
    surface = DenseSurface(mesh if dense is None else dense)
    size_px = raster.face.shape[0]
    normal_map = occlusion = None
    statistics: dict[str, Any] = {}
    if with_normals:
        gutter_px = gutter_for(size_px, settings.gutter_px)
        span = progress.span(0.0, 0.5 if with_occlusion else 1.0)
        baked = bake_normal_map(mesh, unwrapped.corner_uvs, raster, surface, gutter_px, span)
        normal_map, statistics["normal_map"] = baked.image, baked.statistics
    if with_occlusion:
        side_px = min(size_px, MAX_SIDE_PX)
        coarse = raster if side_px == size_px else unwrapped.raster(side_px, threads, atlas)
        gutter_px = gutter_for(side_px, settings.gutter_px)
        span = progress.span(0.5 if with_normals else 0.0, 1.0)
        open_sky = bake_occlusion(mesh, coarse, surface, gutter_px, span)
        occlusion, statistics["ambient_occlusion"] = open_sky.image, open_sky.statistics
    return DetailMaps(normal_map, occlusion, statistics)


def merged_statistics(details: Sequence[DetailMaps]) -> dict[str, Any]:
    """Merge the statistics of the atlases of one mesh; shares are averaged."""
    merged: dict[str, Any] = {}
    for name, first in details[0].statistics.items():
        each = [detail.statistics[name] for detail in details]
        merged[name] = {
            key: float(np.mean([one[key] for one in each])) if key.endswith("_share") else value
            for key, value in first.items()
        }
    return merged
