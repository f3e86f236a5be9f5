# SPDX-License-Identifier: GPL-3.0-or-later
"""A region meshed tile by tile in this process; jobs do the same in worker processes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.field.depth_samples import DepthSamples
from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.tiles.plan import Field
from gaussian_wrapping_addon.core.meshing.tiles.tile_faces import tile_faces
from gaussian_wrapping_addon.core.meshing.tiles.tile_points import gather, tile_points
from gaussian_wrapping_addon.core.meshing.tiles.tiled_mesh import join_tiles, plan_tiles
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.convex_region import Region
from gaussian_wrapping_addon.core.settings import MeshingSettings


def mesh_in_tiles(
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
) -> SurfaceMesh:
    """Mesh a region in ``tiles`` tiles, one after the other."""
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
    return join_tiles(field, plan, gathered, parts, settings, progress.span(0.9, 1.0))
