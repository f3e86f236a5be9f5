# SPDX-License-Identifier: GPL-3.0-or-later
"""Tiled meshing: plan, sample each tile, gather the points, label each tile, join the surfaces."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...field.isosurface_projection import isosurface_residuals
from ...field.samples import DepthSamples
from ...gaussians.model import GaussianArrays
from ...mesh.components import compacted, without_floaters
from ...mesh.simplification import merge_vertices
from ...mesh.surface_mesh import SurfaceMesh
from ...progress import Progress
from ...regions.shapes import Region
from ...scene.camera import Camera
from ...settings import MeshingSettings
from ..primal_adaptive import small_handles_closed
from ..repair import remove_degenerate
from ..spacing import checked_request
from ..surface_points import KIND_SURFACE, Field, candidate_surface, no_surface_error
from .join import Joined, LoadTile, flip_by_tiles, joined, overview
from .plan import TilePlan, make_plan
from .tile import KIND_STEINER, cost_units, longest_edge

_logger = logging.getLogger(__name__)

MARGIN = 1.1
"""Tiles are joined with this many times the vertices that stay, so that the last mergers choose
among all of them."""

MAX_ATTEMPTS = 3
"""Where floaters are large or borders flat, fewer are left than wanted: tiles are joined again."""


def plan_tiles(
    field: Field, arrays: GaussianArrays, cameras: Sequence[Camera], region: Region,
    settings: MeshingSettings, progress: Progress, *,
    tiles: int, seed: int, edge_length_scene: float = 0.0,
    depth_samples: DepthSamples | None = None,
) -> TilePlan:  # fmt: skip
    """Extract the region's candidate surface and split it; 0 ``tiles``: as many as it needs.

    Raises MeshingError: the region holds no surface; UsageError, ResourceError: the request is
    invalid, or needs more points than the limit.
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
    field: Field, plan: TilePlan, point_figures: dict[str, Any], load: LoadTile,
    settings: MeshingSettings, progress: Progress,
) -> SurfaceMesh:  # fmt: skip
    """Join the surfaces of all tiles into one closed 2-manifold, simplified.

    Memory is proportional to the simplified mesh: of the dense surface there is one tile at a time,
    and a band along the borders of those that have been joined.

    ``point_figures`` are the ``figures`` of the gathered points; ``load``, which returns the
    surface of a tile, is called several times for each.
    Raises MeshingError: the region holds no solid, or tiles do not agree on their border.
    """
    known = overview(plan, load, progress.span(0.0, 0.05))
    # With uniform spacing all vertices stay.
    wanted = MARGIN * max(plan.target, plan.share * known.vertices)
    for attempt in range(MAX_ATTEMPTS):
        level = known.level_for(wanted)
        step = progress.span(0.05 + 0.15 * attempt, 0.2 + 0.15 * attempt)
        mesh, between = joined(plan, load, known, level, step)
        figures: dict[str, Any] = {
            "split_vertices": known.figures["split_vertices"] + mesh.split_vertices,
            "split_edges": known.figures["split_edges"] + mesh.split_edges,
        }
        whole = mesh.compacted()
        del mesh
        part, floaters = _without_floaters(plan, whole, settings)
        del whole
        dense = int(part.stand_for.sum(dtype=np.int64))
        target = max(plan.target, round(plan.share * dense))
        if level < 0.0 or len(part.vertices) >= target:
            break
        wanted *= MARGIN * target / len(part.vertices)
    faces, narrow = remove_degenerate(part.vertices, part.faces, known.least_height, plan.region)
    figures |= floaters | {"degenerate_faces_left": narrow, "dense_vertices": dense}
    progress.update(0.5, f"simplifying {dense} vertices")
    if dense > target:
        faces = merge_vertices(
            part.vertices, faces, cost_units(plan.region), target, longest_edge(plan),
            quadrics=part.quadrics,
        ).faces  # fmt: skip
    vertices, faces, chosen = compacted(part.vertices, faces)
    kind = part.kind[chosen]
    del part
    if dense > target:
        faces = flip_by_tiles(
            plan, load, known.boxes, between, vertices, faces, progress.span(0.6, 0.95)
        )
    vertices, faces, kind, counts = small_handles_closed(vertices, faces, kind)
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
        **point_figures,
        **{name: known.figures[name] for name in sums},
        **figures,
        **counts,
        "vertices_of_fillers": int((kind == KIND_STEINER).sum()),
        **isosurface_residuals(field.vacancy, vertices[kind == KIND_SURFACE]),
    }
    progress.update(1.0, f"{len(faces)} faces")
    _logger.info("Meshed region %s: %d faces", plan.region.name, len(faces))
    return SurfaceMesh(vertices, faces.astype(np.int32), provenance)


def _without_floaters(
    plan: TilePlan, whole: Joined, settings: MeshingSettings
) -> tuple[Joined, dict[str, Any]]:
    """Return what has been joined without floaters, and their figures."""
    if len(whole.faces) == 0:
        raise no_surface_error(plan.region, "solid")
    # Closed triangle meshes have twice as many faces as vertices.
    valence = np.bincount(whole.faces.ravel(), minlength=len(whole.vertices))
    each = 2.0 * whole.stand_for / np.maximum(valence, 1)
    floaters = without_floaters(
        whole.vertices, whole.faces, settings.min_component_share, settings.most_parts,
        each[whole.faces].sum(1),
    )  # fmt: skip
    vertices, faces, source = compacted(whole.vertices, floaters.faces)
    part = Joined(
        vertices, faces, whole.kind[source], whole.quadrics[source], whole.stand_for[source]
    )
    return part, floaters.figures()
