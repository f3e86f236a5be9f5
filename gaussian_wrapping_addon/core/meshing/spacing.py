# SPDX-License-Identifier: GPL-3.0-or-later
"""Resolution of a mesh, and the local spacing of its points: no finer than the photos resolve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from .. import limits
from ..errors import ResourceError, UsageError
from ..mesh.sampling import EDGE_PER_RADIUS, POINTS_PER_SQUARE
from ..progress import ReportWarning
from ..regions.shapes import Region
from ..scene.camera import Camera

# -- Resolution of a mesh: requested edge length or number of points, and their limits ------------

AUTOMATIC_POINTS = 24_000
"""Surface points without a request: about 50 thousand faces (48 to 55 thousand in jobs; caps add
some where the region cuts the solid)."""

MIN_VERTICES = 100  # least number of vertices of an adaptive mesh

COARSEST_SHARE = 1 / 8
"""Edges longer than this share of the diagonal would not show a region's contents."""

DENSE_FACTOR = 6.0
"""Vertices of the dense mesh per vertex that adaptive spacing keeps. With fewer, the errors of the
dense mesh dominate; more cost time and lower the error little."""
DENSE_POINTS, LEAST_DENSE_FACTOR = 200_000, 2.0
"""Beyond this many points the factor falls, to this minimum: time stays proportional to points."""

VERTICES_PER_UNIFORM = 0.5
"""Vertices of an adaptive mesh, as a share of the uniform mesh with the requested edge length; both
have the same distance to the surface (benchmarks/meshing_tables.py)."""

FINEST_SHARE = 1e-6  # edges shorter than this share of the diagonal are refused outright


@dataclass(frozen=True)
class ResolutionRequest:
    """A requested edge length or number of points, or neither (0 and 0)."""

    edge_length: float  # scene units
    points: int
    notes: tuple[ReportWarning, ...] = ()  # changes to the request, for the report


def checked_request(edge_length: float, points: int, region: Region) -> ResolutionRequest:
    """Validate a request before any work is done; clamp edges that are too long.

    Raises UsageError: a value is not finite or negative, or both are given; ResourceError: it is
    too fine.
    """
    if not math.isfinite(edge_length) or edge_length < 0 or points < 0:
        raise UsageError(
            f"Edge length {edge_length} with {points} points is invalid.",
            "Give a positive edge length, or a number of points, or leave both 0.",
        )
    if edge_length > 0 and points > 0:
        raise UsageError("Both an edge length and a number of points are given.", "Give one.")
    if points > limits.MAX_MESH_POINTS:
        raise ResourceError(
            f"{points} surface points are too many.", f"Ask for {limits.MAX_MESH_POINTS} at most."
        )
    if 0 < edge_length < FINEST_SHARE * region.diagonal:
        raise ResourceError(
            f"Region {region.name!r} is {region.diagonal / edge_length:.2g} edges long: too many.",
            "Use edges of a thousandth of the region's diagonal, a smaller region, or leave the "
            "edge length out.",
        )
    coarsest = COARSEST_SHARE * region.diagonal
    if edge_length > coarsest:
        share = f"1/{1 / COARSEST_SHARE:.0f} of the region's diagonal"
        text = f"The edge length was larger than {share} and was reduced to that."
        return ResolutionRequest(coarsest, 0, (ReportWarning("edge-length-reduced", text),))
    return ResolutionRequest(edge_length, points)


def thinning_radius(request: ResolutionRequest, area: float, region: Region) -> float:
    """Return the radius that meets the request evenly on a candidate surface of this area."""
    if request.edge_length > 0:
        return request.edge_length / EDGE_PER_RADIUS
    points = request.points or AUTOMATIC_POINTS
    radius = float(np.sqrt(POINTS_PER_SQUARE * area / points))
    return min(radius, COARSEST_SHARE * region.diagonal)


def check_expected_points(points: float, request: ResolutionRequest) -> None:
    """Refuse an edge length that needs more than ``limits.MAX_MESH_POINTS``: ResourceError."""
    if request.edge_length > 0 and points > limits.MAX_MESH_POINTS:
        factor = times_longer(points, limits.MAX_MESH_POINTS)
        raise ResourceError(
            f"This edge length needs about {points:.1e} surface points; "
            f"the limit is {limits.MAX_MESH_POINTS:.0e}.",
            f"Use edges {factor} times longer, or a smaller region.",
        )


def times_longer(points: float, most: float) -> str:
    """Return by how much edges must be longer for fewer points: rounded up, with some to spare."""
    return f"{math.ceil(105.0 * math.sqrt(points / most)) / 100.0:.2f}"


@dataclass(frozen=True)
class DenseRequest:
    """Resolution of the dense mesh that an adaptive mesh is simplified from."""

    request: ResolutionRequest
    target: int  # vertices to keep, for the surface without caps
    share: float  # the same as a share of the dense mesh, which also has vertices on caps


def dense_points(stay: float) -> float:
    """Return the points of the dense mesh for a number of vertices to keep."""
    return max(min(DENSE_FACTOR * stay, DENSE_POINTS), LEAST_DENSE_FACTOR * stay)


def kept_from_dense(points: float) -> float:
    """Return the vertices kept, at most, of a dense mesh: the inverse of :func:`dense_points`."""
    return points / (LEAST_DENSE_FACTOR if points >= DENSE_POINTS else DENSE_FACTOR)


def dense_request(
    request: ResolutionRequest, area: float, region: Region, *, adaptive: bool = True
) -> DenseRequest:
    """Return the resolution of the dense mesh, and how many vertices to keep: all if not adaptive.

    Raises ResourceError: the dense mesh needs more points than the limit.
    """
    if not adaptive:
        return DenseRequest(request, 0, 1.0)
    expected = POINTS_PER_SQUARE * area / thinning_radius(request, area, region) ** 2
    share = VERTICES_PER_UNIFORM if request.edge_length > 0 else 1.0
    target, notes = round(share * expected), request.notes
    if target < MIN_VERTICES:
        asked = request.points or target  # with an edge length, the points that it implies
        least = f"An adaptive mesh has at least {MIN_VERTICES} surface points"
        notes = (*notes, ReportWarning("points-raised", f"{least}; {asked} were requested."))
        target = MIN_VERTICES
    dense = dense_points(target)
    if request.edge_length > 0:
        check_expected_points(dense, request)
        edge = request.edge_length * math.sqrt(expected / dense)
        of_dense = ResolutionRequest(edge, 0, notes)
    else:
        of_dense = ResolutionRequest(0.0, round(dense), notes)
    return DenseRequest(of_dense, target, target / dense)


def nominal_edge(request: ResolutionRequest, area: float, region: Region) -> float:
    """Return the edge length of the uniform mesh that meets a request."""
    return EDGE_PER_RADIUS * thinning_radius(request, area, region)


# -- Local spacing of surface points: no finer than the photos resolve, with bounded gradation ----

EDGE_PER_PIXEL = 0.5
"""Shortest edge, in pixels of the nearest camera. The finest pattern in a photo has a period of two
pixels; four vertices represent it."""

GRADING = 0.4
"""Edges lengthen by at most this share of the distance, so that triangles stay well shaped."""

LONGEST_SHARE = 8.0
"""Edges are lengthened to at most this many nominal ones, however far the nearest camera is."""


def footprints(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the smallest pixel footprint over the cameras at each point, (n,); 0 where unseen."""
    finest = np.full(len(points), np.inf)
    for camera in cameras:
        pixel, depth = camera.project(points)
        inside = (depth > 0) & (pixel >= 0).all(1)
        inside &= (pixel[:, 0] <= camera.width) & (pixel[:, 1] <= camera.height)
        size = depth / max(camera.fx, camera.fy)
        finest = np.where(inside, np.minimum(finest, size), finest)
    return np.where(np.isfinite(finest), finest, 0.0)


def resolved_edges(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the shortest edge that the photos resolve at each point, (n,); 0 where unseen."""
    return EDGE_PER_PIXEL * footprints(points, cameras)


@dataclass(frozen=True)
class Spacing:
    """Local thinning radii, sampled at points of the surface."""

    points: np.ndarray  # (n, 3) float64
    radii: np.ndarray  # (n,) float64
    nominal: float  # radius where the photos do not limit it: the smallest one
    limited: float  # share of the area where the photos limit the radius

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    @classmethod
    def uniform(cls, radius: float) -> Spacing:
        """Return the same spacing everywhere."""
        return cls(np.zeros((1, 3)), np.array([radius]), radius, 0.0)

    def at(self, where: np.ndarray, threads: int = 1) -> np.ndarray:
        """Return the radius at (m, 3) points; it grows with the distance to samples."""
        if len(self.points) == 1:
            return np.full(len(where), self.radii[0])
        k = min(4, len(self.points))
        distance, index = self._tree.query(where, k=k, workers=threads)
        weight = 1.0 / (distance**2 + (0.5 * self.radii[index]) ** 2)
        mean = (weight * self.radii[index]).sum(1) / weight.sum(1)
        return mean + GRADING / EDGE_PER_RADIUS * np.maximum(distance[:, 0] - mean, 0.0)


def footprint_spacing(points: np.ndarray, cameras: Sequence[Camera], radius: float) -> Spacing:
    """Return a radius everywhere, larger where the photos resolve no edges so short.

    ``points`` (n, 3) are spread evenly over the surface; ``radius`` is that of the nominal edge.
    """
    edge = EDGE_PER_RADIUS * radius
    resolved = np.minimum(resolved_edges(points, cameras), LONGEST_SHARE * edge)
    limited = float(np.mean(resolved > edge)) if len(points) else 0.0
    if limited == 0.0:
        return Spacing.uniform(radius)
    distance, index = cKDTree(points).query(points, k=min(8, len(points)))
    edges, step = np.maximum(resolved, edge), GRADING * distance
    while True:  # shorten edges until those of neighbours differ by no more than their grading
        # In both directions: nearest-neighbour relations are not symmetric.
        lower = np.minimum(edges, (edges[index] + step).min(1))
        np.minimum.at(lower, index, lower[:, None] + step)
        if (lower > 0.99 * edges).all():
            return Spacing(points, lower / EDGE_PER_RADIUS, radius, limited)
        edges = lower
