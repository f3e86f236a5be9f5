# SPDX-License-Identifier: GPL-3.0-or-later
"""Tiled meshing: plan, sample each tile, gather the points, label each tile, join the faces."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...dataset.camera import Camera
from ...field.depth_samples import DepthSamples
from ...gaussians.model import GaussianArrays
from ...mesh.surface_mesh import SurfaceMesh
from ...progress import Progress
from ...regions.convex_region import Region
from ...settings import MeshingSettings
from ..points.candidate_surface import candidate_surface
from ..points.resolution import checked_request
from ..primal_adaptive import (
    made_manifold,
    residuals_on_surface,
    simplified,
    small_handles_closed,
    vertex_counts,
)
from .plan import Field, TilePlan, make_plan
from .tile_faces import TileFaces, joined_faces
from .tile_points import KIND_STEINER, GatheredPoints

_logger = logging.getLogger(__name__)


def plan_tiles(
    field: Field,
    arrays: GaussianArrays,
    cameras: Sequence[Camera],
    region: Region,
    settings: MeshingSettings,
    progress: Progress,
    *,
    tiles: int,
    seed: int,
    edge_length_scene: float = 0.0,
    depth_samples: DepthSamples | None = None,
) -> TilePlan:
    """Extract the region's candidate surface and split it into tiles.

    Parameters
    ----------
    tiles : int
        Number of tiles; 0 chooses it by the request.

    Raises
    ------
    MeshingError
        The region holds no surface.
    UsageError, ResourceError
        The request is invalid, or needs more points than the limit.
    """
    request = checked_request(edge_length_scene, settings.points, region)
    surface = candidate_surface(
        arrays, region, field.vacancy.is_empty, 0.5 * request.edge_length, seed,
        progress.span(0.0, 0.6), depth_samples,
    )  # fmt: skip
    plan = make_plan(
        field, region, surface, request, progress.span(0.6, 1.0), tiles=tiles, seed=seed,
        cameras=cameras, adaptive=settings.spacing == "adaptive",
        depth_samples=0 if depth_samples is None else len(depth_samples),
    )  # fmt: skip
    _logger.info("Region %s is meshed in %d tiles", region.name, len(plan.tiling))
    return plan


def join_tiles(
    field: Field,
    plan: TilePlan,
    gathered: GatheredPoints,
    parts: list[TileFaces],
    settings: MeshingSettings,
    progress: Progress,
) -> SurfaceMesh:
    """Join the faces of all tiles into one closed 2-manifold and simplify it.

    The joined surface is held in one piece: memory is proportional to it, not to a tile, but the
    tetrahedra, which are many times larger, never exist all at once.

    Parameters
    ----------
    parts : list of TileFaces
        In the order of the tiles.

    Raises
    ------
    MeshingError
        The region holds no solid, or tiles do not agree on their border.
    """
    faces = joined_faces(parts)
    progress.update(0.1, f"joining {len(plan.tiling)} tiles")
    cloud = gathered.cloud
    vertices, faces, kind, figures = made_manifold(
        cloud.points, faces, cloud, plan.region, settings, progress
    )
    figures["dense_vertices"] = len(vertices)
    progress.update(0.95, f"simplifying {len(vertices)} vertices")
    vertices, faces, kind = simplified(vertices, faces, kind, plan.target, plan.share, plan.region)
    vertices, faces, kind, handles = small_handles_closed(vertices, faces, kind)
    figures |= handles | vertex_counts(kind)
    sums = ("tetrahedra", "interior_samples", "relabelled_tetrahedra", "undecided_tetrahedra")
    provenance: dict[str, Any] = {
        "method": "primal adaptive meshing",
        "region": plan.region.name,
        "tiles": len(plan.tiling),
        "edge_length_scene": plan.edge_length,
        "gaussians_in_region": plan.surface.gaussians,
        "pivots": plan.surface.pivots,
        "sightings": plan.depth_samples,
        "candidate_area": plan.area,
        "spacing": settings.spacing,
        "notes": [note.to_json() for note in plan.notes],
        "seed": plan.seed,
        **cloud.figures,
        **{name: sum(part.figures.get(name, 0) for part in parts) for name in sums},
        **figures,
        "vertices_of_fillers": int((kind == KIND_STEINER).sum()),
        **residuals_on_surface(field.vacancy, vertices, kind),
    }
    progress.update(1.0, f"{len(faces)} faces")
    _logger.info("Meshed region %s: %d faces", plan.region.name, len(faces))
    return SurfaceMesh(vertices, faces.astype(np.int32), None, provenance)
