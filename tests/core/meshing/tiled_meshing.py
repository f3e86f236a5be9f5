# SPDX-License-Identifier: GPL-3.0-or-later
"""A region meshed tile by tile in this process; jobs do the same in worker processes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.field.samples import DepthSamples
from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.surface_points import Field
from gaussian_wrapping_addon.core.meshing.tiles.plan import TilePlan
from gaussian_wrapping_addon.core.meshing.tiles.tile import (
    BorderFaces,
    GatheredPoints,
    TileFaces,
    TileSurface,
    gather,
    tile_faces,
    tile_points,
    tile_surface,
)
from gaussian_wrapping_addon.core.meshing.tiles.tiled_mesh import join_tiles, plan_tiles
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings import MeshingSettings


@dataclass(frozen=True)
class LabelledTiles:
    """All that tiles have made before they are joined."""

    field: Field
    plan: TilePlan
    gathered: GatheredPoints
    parts: list[TileFaces]

    def join(
        self,
        settings: MeshingSettings,
        progress: Progress | None = None,
        surfaces: Sequence[TileSurface] | None = None,
    ) -> SurfaceMesh:
        """Join the tiles."""
        surfaces = self.surfaces() if surfaces is None else surfaces
        return join_tiles(
            self.field, self.plan, self.gathered.cloud.figures, surfaces.__getitem__, settings,
            progress or Progress(),
        )  # fmt: skip

    def surfaces(self) -> list[TileSurface]:
        """Return the tiles' surfaces."""
        return [tile_surface(self.plan, self.gathered, part) for part in self.parts]

    def dense_faces(self) -> np.ndarray:
        """Return all faces together, (f, 3) indices of the gathered points."""
        border = BorderFaces()
        faces = [part.faces for part in self.parts]
        faces += [border.add(part.border, part.solid) for part in self.parts]
        corners = [np.unique(part.border) for part in self.parts]
        faces.append(border.close(np.unique(np.concatenate(corners))))
        return np.concatenate(faces)


def mesh_in_tiles(
    vacancy: Any,
    vectors: Any,
    arrays: GaussianArrays,
    cameras: Sequence[Camera],
    region: Region,
    settings: MeshingSettings,
    progress: Progress,
    **options: Any,
) -> SurfaceMesh:
    """Mesh a region tile by tile; options are those of ``labelled_tiles``."""
    labelled = labelled_tiles(
        vacancy, vectors, arrays, cameras, region, settings, progress.span(0.0, 0.9), **options
    )
    return labelled.join(settings, progress.span(0.9, 1.0))


def labelled_tiles(
    vacancy: Any,
    vectors: Any,
    arrays: GaussianArrays,
    cameras: Sequence[Camera],
    region: Region,
    settings: MeshingSettings,
    progress: Progress,
    *,
    tiles: int,
    seed: int,
    threads: int,
    edge_length_scene: float = 0.0,
    depth_samples: DepthSamples | None = None,
) -> LabelledTiles:
    """Plan a region in ``tiles`` tiles, sample and label them."""
    field = Field(vacancy, vectors, threads)
    plan = plan_tiles(
        field, arrays, cameras, region, settings, progress.span(0.0, 0.3), tiles=tiles, seed=seed,
        edge_length_scene=edge_length_scene, depth_samples=depth_samples,
    )  # fmt: skip
    count = len(plan.tiling)
    sampling, labelling = progress.span(0.3, 0.6), progress.span(0.6, 0.9)
    points = [
        tile_points(field, plan, tile, sampling.span(tile / count, (tile + 1) / count))
        for tile in range(count)
    ]
    gathered = gather(plan, points)
    parts = [
        tile_faces(field, plan, gathered, tile, labelling.span(tile / count, (tile + 1) / count))
        for tile in range(count)
    ]
    return LabelledTiles(field, plan, gathered, parts)
