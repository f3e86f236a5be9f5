# SPDX-License-Identifier: GPL-3.0-or-later
"""Pivot meshing: marching tetrahedra on the Delaunay triangulation of the Gaussians' pivots.

See docs/method.md, section 6.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import MeshingError
from ..field.isosurface_projection import isosurface_residuals
from ..field.samples import DepthSamples
from ..gaussians.model import GaussianArrays
from ..mesh.components import compacted, without_floaters
from ..mesh.surface_mesh import SurfaceMesh, edge_lengths
from ..progress import Progress, ReportWarning
from ..regions.scene_regions import cap_planes
from ..regions.shapes import Region
from ..scene.camera import Camera
from ..settings import MeshingSettings
from .classification import tetrahedron_neighbours
from .delaunay import bounding_points, delaunay
from .marching_tetrahedra import bisect, cut_to_region, marching_closed
from .pivots import pivot_rule
from .repair import remove_degenerate
from .spacing import footprints
from .surface_points import no_surface_error, pivot_cloud, pivots_alone

_logger = logging.getLogger(__name__)

BRACKET_SHARE = 0.02
"""Vertices are bracketed to this share of the local pixel footprint, or of their edge where that is
shorter: the photos resolve nothing finer (docs/method.md, section 6.4)."""

DEGENERATE_SHARE = 1e-3
"""Faces narrower than this share of the median edge are removed: where the isosurface passes close
to a point, it cuts slivers."""


def mesh_by_pivots(
    vacancy: Any, arrays: GaussianArrays, cameras: Sequence[Camera], region: Region,
    settings: MeshingSettings, progress: Progress, *,
    seed: int, depth_samples: DepthSamples | None = None,
) -> SurfaceMesh:  # fmt: skip
    """Mesh the surface ``vacancy = 0.5`` inside a region at the resolution of the Gaussians.

    The tetrahedra are clipped to the region's planes before the field is evaluated, so that the
    solid ends exactly on these planes, with sharp edges. No tetrahedron is dropped, hence the mesh
    is closed and manifold (docs/method.md, section 6.5).

    Parameters
    ----------
    vacancy : VacancyField
        Or any object with ``vacancy(points)`` and ``is_empty(points)``.
    arrays : GaussianArrays
        Scene frame.
    cameras : sequence of Camera
        The field's cameras; must not be empty. Their pixel footprints set the bracket tolerance.
    region : Region
        Scene frame.
    settings : MeshingSettings
        ``pivots`` (per Gaussian), ``pivot_box``, ``pivot_samples`` and ``min_component_share`` are
        used. An edge length or a number of points does not apply; the provenance notes that.
    depth_samples : DepthSamples, optional
        Depth-map samples of the isosurface in the region (:mod:`.samples`); not used with
        ``pivot_samples = "none"``.

    Returns
    -------
    SurfaceMesh
        Closed, 2-manifold, oriented outward.

    Raises
    ------
    MeshingError
        The region holds no surface, or no Gaussian reaches it.
    """
    if len(cameras) == 0:
        raise MeshingError("The scene has no cameras.", "Check the scene.")
    rule = pivot_rule(settings.pivots, settings.pivot_box)
    if settings.pivot_samples == "none":
        depth_samples = None
        cloud = pivots_alone(arrays, region, rule)
    else:
        cloud = pivot_cloud(arrays, region, vacancy.is_empty, seed, depth_samples, pivots_of=rule)
    points = np.concatenate([cloud.points, bounding_points(cloud.points, seed)])
    tetrahedra = delaunay(points, seed=seed, progress=progress.span(0.0, 0.3))
    cut = cut_to_region(points, tetrahedra, region)
    used = np.unique(cut.tetrahedra)
    progress.update(0.3, f"evaluating {len(used)} pivots")
    inside = np.zeros(len(cut.points), np.bool_)  # points of no tetrahedron count as empty
    inside[used] = ~vacancy.is_empty(cut.points[used])
    edges, faces = marching_closed(cut.tetrahedra, tetrahedron_neighbours(cut.tetrahedra), inside)
    if len(faces) == 0:
        raise no_surface_error(region)
    begin, end = cut.points[edges[:, 0]], cut.points[edges[:, 1]]
    pixel = footprints((begin + end) / 2, cameras)  # (e,)
    limit = np.linalg.norm(end - begin, axis=1)
    limit = np.where(pixel > 0.0, np.minimum(limit, pixel), limit)
    ends = bisect(begin, end, vacancy.is_empty, BRACKET_SHARE * limit, progress.span(0.5, 0.9))
    vertices = (ends[0] + ends[1]) / 2
    progress.update(0.9, "repairing")
    floaters = without_floaters(vertices, faces, settings.min_component_share, settings.most_parts)
    height = DEGENERATE_SHARE * float(np.median(edge_lengths(vertices, faces)))
    kept, degenerate = remove_degenerate(vertices, floaters.faces, height, region)
    vertices, kept, _ = compacted(vertices, kept)
    capped = (cap_planes(vertices, region).planes >= 0).any(1)
    provenance = {
        "method": "marching tetrahedra on pivots",
        "region": region.name,
        "pivots_each": settings.pivots,
        "pivot_box": settings.pivot_box if settings.pivots == 9 else "",
        "pivot_samples": settings.pivot_samples,
        "gaussians_in_region": cloud.gaussians,
        "pivots": len(cloud.points),
        "sightings": 0 if depth_samples is None else len(depth_samples),
        "tetrahedra": len(cut.tetrahedra),
        "notes": _notes(settings, cloud.gaussians, cloud.chosen),
        "seed": seed,
        **floaters.figures(),
        "degenerate_faces_left": degenerate,
        "vertices_on_surface": int((~capped).sum()),
        "vertices_on_region_boundary": int(capped.sum()),
        **isosurface_residuals(vacancy, vertices[~capped]),
    }
    progress.update(1.0, f"{len(kept)} faces")
    _logger.info("Meshed region %s by pivots: %d faces", region.name, len(kept))
    return SurfaceMesh(vertices, kept.astype(np.int32), provenance)


def _notes(settings: MeshingSettings, gaussians: int, chosen: int) -> list[dict[str, str]]:
    notes = []
    if settings.edge_length > 0 or settings.points > 0:
        text = "The pivots set the resolution; no edge length or number of points applies."
        notes.append(ReportWarning("resolution-not-applied", text))
    if chosen < gaussians:
        text = f"{chosen} of {gaussians} Gaussians were used, to limit memory."
        notes.append(ReportWarning("some-gaussians-chosen", text))
    return [note.to_json() for note in notes]
