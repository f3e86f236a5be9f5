# SPDX-License-Identifier: GPL-3.0-or-later
"""Primal adaptive meshing: extract a closed mesh of a region at any resolution.

See docs/method.md, section 7.
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
from ..mesh.simplification import flip_edges, select_vertices
from ..mesh.surface_mesh import SurfaceMesh, edge_lengths
from ..progress import Progress
from ..regions.shapes import Region
from ..scene.camera import Camera
from ..settings import MeshingSettings
from .classification import boundary_faces, classify, tetrahedron_neighbours
from .clean_up import without_small_handles
from .delaunay import bounding_points, delaunay
from .repair import remove_degenerate, split_nonmanifold
from .spacing import checked_request, dense_request, nominal_edge
from .surface_points import (
    KIND_CAP,
    KIND_JUMP,
    KIND_SURFACE,
    Field,
    SurfacePoints,
    SurfaceSampler,
    candidate_surface,
    no_surface_error,
)

_logger = logging.getLogger(__name__)

KIND_SPLIT = 3  # moved slightly off the isosurface to separate parts that would touch

DEGENERATE_SHARE = 1e-3
"""Faces narrower than this share of the spacing are removed: collinear points on the region's edges
form such faces, in either orientation."""

LONGEST_EDGE_SHARE = 1 / 8
"""Edges of the adaptive mesh are at most this share of the region's diagonal."""


def mesh_region(
    field: Field, arrays: GaussianArrays, cameras: Sequence[Camera], region: Region,
    settings: MeshingSettings, progress: Progress, *,
    seed: int, edge_length_scene: float = 0.0, depth_samples: DepthSamples | None = None,
) -> SurfaceMesh:  # fmt: skip
    """Mesh the surface ``vacancy = 0.5`` inside a region, closed by caps on the region's boundary.

    With adaptive spacing a denser mesh is extracted and simplified to the vertices that its shape
    needs (:mod:`.simplification`). The vacancy decides about space that no
    camera sees. Without an edge length or a number of points the mesh has about 50 thousand faces.

    Parameters
    ----------
    field : Field
    arrays : GaussianArrays
        Scene frame.
    cameras : sequence of Camera
        The field's cameras; must not be empty.
    region : Region
        Scene frame.
    settings : MeshingSettings
        ``points``, ``spacing`` and ``min_component_share`` are used; the edge length is passed in
        scene units. Smoothing, decimation and an open boundary are separate steps on the finished
        mesh; ``unseen`` concerns the field.
    seed : int
        The same seed gives the same mesh, for any number of threads.
    edge_length_scene : float
        Edge length of a uniform mesh, in scene units; an adaptive mesh has half as many vertices.
        0 means that ``settings.points`` applies.
    depth_samples : DepthSamples, optional
        Depth-map samples of the isosurface in the region (:mod:`.samples`).

    Returns
    -------
    SurfaceMesh
        Closed, 2-manifold, oriented outward. ``provenance`` holds counts, and ``|v - 0.5|`` at the
        vertices on the isosurface.

    Raises
    ------
    MeshingError
        The region holds no surface.
    UsageError, ResourceError
        The request is invalid, or needs more points than the limit.
    """
    if len(cameras) == 0:
        raise MeshingError("The scene has no cameras.", "Check the scene.")
    vacancy = field.vacancy
    request = checked_request(edge_length_scene, settings.points, region)
    rng = np.random.default_rng(seed)
    surface = candidate_surface(
        arrays, region, vacancy.is_empty, 0.5 * request.edge_length, seed, progress.span(0.0, 0.3),
        depth_samples,
    )  # fmt: skip
    adaptive = settings.spacing == "adaptive"
    sampler = SurfaceSampler(field, region, surface, cameras if adaptive else ())
    dense = dense_request(request, sampler.area, region, adaptive=adaptive)
    cloud = sampler.sample(dense.request, rng, progress.span(0.3, 0.6))
    vertices, faces, kind, figures = _connect(cloud, vacancy, region, settings, seed, rng, progress)
    figures["dense_vertices"] = len(vertices)
    vertices, faces, kind = simplified(vertices, faces, kind, dense.target, dense.share, region)
    vertices, faces, kind, counts = small_handles_closed(vertices, faces, kind)
    provenance = {
        "method": "primal adaptive meshing",
        "region": region.name,
        "edge_length_scene": nominal_edge(request, sampler.area, region),
        "gaussians_in_region": surface.gaussians,
        "pivots": surface.pivots,
        "sightings": 0 if depth_samples is None else len(depth_samples),
        "candidate_area": sampler.area,
        "spacing": settings.spacing,
        "notes": [note.to_json() for note in (*dense.request.notes, *cloud.notes)],
        "seed": seed,
        **cloud.figures,
        **figures,
        **counts,
        **isosurface_residuals(vacancy, vertices[kind == KIND_SURFACE]),
    }
    progress.update(1.0, f"{len(faces)} faces")
    _logger.info("Meshed region %s: %d faces", region.name, len(faces))
    return SurfaceMesh(vertices, faces.astype(np.int32), provenance)


def _connect(
    cloud: SurfacePoints, vacancy: Any, region: Region, settings: MeshingSettings, seed: int,
    rng: np.random.Generator, progress: Progress,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:  # fmt: skip
    """Connect points to a closed manifold: Delaunay, labels, boundary faces, repair."""
    if len(cloud.points) < 4:
        raise no_surface_error(region)
    points = np.concatenate([cloud.points, bounding_points(cloud.points, seed)])
    tetrahedra = delaunay(points, seed=seed, progress=progress.span(0.6, 0.65))
    neighbours = tetrahedron_neighbours(tetrahedra)
    # The points lie in a convex body: only tetrahedra with a bounding point reach beyond it.
    outer = (tetrahedra >= len(cloud.points)).any(1)
    labels = classify(
        points, tetrahedra, neighbours, outer, cloud.normals, cloud.radii, vacancy, rng,
        progress.span(0.65, 0.9),
    )  # fmt: skip
    faces = boundary_faces(tetrahedra, neighbours, labels.inside)
    figures = {
        "tetrahedra": len(tetrahedra),
        "interior_samples": int(labels.samples[~outer].sum()),
        "undecided_tetrahedra": labels.undecided,
        "relabelled_tetrahedra": labels.flipped,
    }
    vertices, faces, kind, repairs = made_manifold(points, faces, cloud, region, settings, progress)
    return vertices, faces, kind, {**figures, **repairs}


def made_manifold(
    points: np.ndarray, faces: np.ndarray, cloud: SurfacePoints, region: Region,
    settings: MeshingSettings, progress: Progress,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:  # fmt: skip
    """Repair closed faces to a manifold; remove floaters and degenerate faces.

    ``points`` (n, 3) begin with the cloud's; ``faces`` (f, 3) int64 are closed: every edge has as
    many in one direction as in the other. Returns vertices, faces, kinds of vertices and figures.
    Raises MeshingError: there are no faces.
    """
    if len(faces) == 0:
        raise no_surface_error(region, "solid")
    progress.update(0.9, "repairing")
    repaired = split_nonmanifold(points, faces)
    floaters = without_floaters(
        repaired.vertices, repaired.faces, settings.min_component_share, settings.most_parts
    )
    kept, degenerate = remove_degenerate(
        repaired.vertices, floaters.faces, DEGENERATE_SHARE * float(cloud.radii.min()), region
    )
    vertices, kept, source = compacted(repaired.vertices, kept)
    figures = {
        "split_vertices": repaired.split_vertices,
        "split_edges": repaired.split_edges,
        **floaters.figures(),
        "degenerate_faces_left": degenerate,
    }
    progress.update(0.95, "repairing")
    return vertices, kept, kinds_after(cloud.kind, repaired.origin)[source], figures


def kinds_after(before: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the kinds of repaired vertices, (w,) uint8.

    ``before``: (v,) uint8 kinds of the vertices before; ``origin``: see
    :class:`.repair.RepairResult`.
    """
    copies = np.bincount(origin[origin >= 0], minlength=len(before))
    moved = (origin < 0) | (copies[np.maximum(origin, 0)] > 1)
    return np.where(moved, KIND_SPLIT, before[np.maximum(origin, 0)]).astype(np.uint8)


def simplified(
    vertices: np.ndarray, faces: np.ndarray, kind: np.ndarray, target: int, share: float,
    region: Region,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Simplify a closed 2-manifold to the vertices that its shape needs; return their kinds too.

    At least ``target`` vertices are kept, or this ``share`` of them where that is more: 1, for
    uniform spacing, keeps all. Edges between them are flipped to stay closest to the given mesh.
    """
    target = max(target, round(share * len(vertices)))
    if len(vertices) <= target:
        return vertices, faces, kind
    longest = LONGEST_EDGE_SHARE * region.diagonal
    kept, coarse, chosen = compacted(vertices, select_vertices(vertices, faces, target, longest))
    return kept, flip_edges(kept, coarse, vertices, faces, longest), kind[chosen]


def small_handles_closed(
    vertices: np.ndarray, faces: np.ndarray, kind: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, int]]:
    """Close the handles of a closed 2-manifold that are too small for its edges to resolve.

    Returns vertices, faces, kinds, and counts for the report, also of the vertices of each kind.
    """
    edge_length = float(np.median(edge_lengths(vertices, faces)))
    faces, closed, left = without_small_handles(vertices, faces, edge_length)
    vertices, faces, chosen = compacted(vertices, faces)
    kind = kind[chosen]
    figures = {
        "small_handles_closed": closed,
        "small_handles_left": left,
        "vertices_on_surface": int((kind == KIND_SURFACE).sum()),
        "vertices_on_region_boundary": int((kind == KIND_CAP).sum()),
        "vertices_at_end_of_sight": int((kind == KIND_JUMP).sum()),
        "vertices_moved_apart": int((kind == KIND_SPLIT).sum()),
    }
    return vertices, faces, kind, figures
