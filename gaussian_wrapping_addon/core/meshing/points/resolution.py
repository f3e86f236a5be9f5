# SPDX-License-Identifier: GPL-3.0-or-later
"""How densely a region is meshed: edge length, number of points, and their caps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ... import limits
from ...errors import ResourceError, UsageError
from ...mesh.surface_sampling import EDGE_PER_RADIUS, POINTS_PER_SQUARE
from ...regions.convex_region import Region
from ...report_warning import ReportWarning

AUTOMATIC_POINTS = 24_000
"""Surface points where nothing is asked for: about 50 thousand faces (48 to 55 thousand in jobs;
where the region cuts the solid, its boundary adds some)."""

MIN_VERTICES = 100
"""An adaptive mesh keeps at least so many."""

COARSEST_SHARE = 1 / 8
"""Edges longer than this share of the diagonal would not show a region's contents."""

DENSE_FACTOR = 6.0
"""Vertices of the mesh from which adaptive spacing selects, for each one that stays. With fewer,
the errors of that mesh are what is left; more cost time without lessening them much."""
DENSE_POINTS, LEAST_DENSE_FACTOR = 200_000, 2.0
"""Beyond so many points the factor falls, to this one: time stays in proportion to the request."""

VERTICES_PER_UNIFORM = 0.5
"""Vertices of an adaptive mesh, of those of the uniform one with the requested edge length: it
reaches the same distance to the surface with these (benchmarks/meshing_parts/spacing.py)."""

FINEST_SHARE = 1e-6
"""Edges shorter than this share of the diagonal are refused without any computation."""


@dataclass(frozen=True)
class ResolutionRequest:
    """What was asked for: an edge length, a number of points, or neither (0 and 0)."""

    edge_length: float
    """Scene units."""
    points: int
    notes: tuple[ReportWarning, ...] = ()
    """What was changed, for the report."""


def checked_request(edge_length: float, points: int, region: Region) -> ResolutionRequest:
    """Check a request before any work is done.

    Raises
    ------
    UsageError
        Not a number, negative, or both given.
    ResourceError
        Absurdly fine.
    """
    if not math.isfinite(edge_length) or edge_length < 0 or points < 0:
        raise UsageError(
            f"Edge length {edge_length} with {points} points is not possible.",
            "Give a positive edge length, or a number of points, or leave both 0.",
        )
    if edge_length > 0 and points > 0:
        raise UsageError("Both an edge length and a number of points are given.", "Give one.")
    if points > limits.MAX_MESH_POINTS:
        raise ResourceError(
            f"{points} surface points are too many.", f"Ask for {limits.MAX_MESH_POINTS} at most."
        )
    if 0 < edge_length < FINEST_SHARE * region.diagonal:
        factor = FINEST_SHARE * region.diagonal / edge_length
        raise ResourceError(
            f"Region {region.name!r} is {region.diagonal / edge_length:.2g} edges long: too many.",
            f"Use edges at least {math.ceil(factor)} times longer, or a smaller region.",
        )
    coarsest = COARSEST_SHARE * region.diagonal
    if edge_length > coarsest:
        share = f"1/{1 / COARSEST_SHARE:.0f} of the region's diagonal"
        text = f"The edge length was larger than {share} and was reduced to that."
        return ResolutionRequest(coarsest, 0, (ReportWarning("edge-length-reduced", text),))
    return ResolutionRequest(edge_length, points)


def thinning_radius(request: ResolutionRequest, area: float, region: Region) -> float:
    """Return the thinning radius that answers the request with the same spacing everywhere.

    Parameters
    ----------
    area : float
        Area of the candidate surface in the region.
    """
    if request.edge_length > 0:
        return request.edge_length / EDGE_PER_RADIUS
    points = request.points or AUTOMATIC_POINTS
    radius = float(np.sqrt(POINTS_PER_SQUARE * area / points))
    return min(radius, COARSEST_SHARE * region.diagonal)


def check_expected_points(points: float, request: ResolutionRequest) -> None:
    """Refuse an edge length that needs too many points.

    Raises
    ------
    ResourceError
        More than ``limits.MAX_MESH_POINTS`` are expected.
    """
    if request.edge_length > 0 and points > limits.MAX_MESH_POINTS:
        factor = math.sqrt(points / limits.MAX_MESH_POINTS)
        raise ResourceError(
            f"This edge length needs about {points:.1e} surface points; "
            f"{limits.MAX_MESH_POINTS:.0e} is the most.",
            f"Use edges at least {factor:.2g} times longer, or a smaller region.",
        )


@dataclass(frozen=True)
class DenseRequest:
    """The mesh from which the vertices of an adaptive one are selected."""

    request: ResolutionRequest
    target: int
    """Vertices that stay, for the surface alone."""
    share: float
    """The same, of the dense mesh: where the region cuts the solid, its boundary has some too."""


def dense_points(stay: float) -> float:
    """Return how many points a mesh has from which so many are selected."""
    return max(min(DENSE_FACTOR * stay, DENSE_POINTS), LEAST_DENSE_FACTOR * stay)


def kept_from_dense(points: float) -> float:
    """Return how many stay, at most, of a mesh of so many points: the inverse of the above."""
    return points / (LEAST_DENSE_FACTOR if points >= DENSE_POINTS else DENSE_FACTOR)


def dense_request(request: ResolutionRequest, area: float, region: Region) -> DenseRequest:
    """Tell how dense a mesh to make, and how many of its vertices to keep, for a request.

    Raises
    ------
    ResourceError
        The dense mesh needs more points than the cap.
    """
    expected = POINTS_PER_SQUARE * area / thinning_radius(request, area, region) ** 2
    share = VERTICES_PER_UNIFORM if request.edge_length > 0 else 1.0
    target, notes = round(share * expected), request.notes
    if target < MIN_VERTICES:
        asked = request.points or target  # with an edge length, what it comes to
        text = (
            f"An adaptive mesh has at least {MIN_VERTICES} surface points; {asked} were asked for."
        )
        notes = (*notes, ReportWarning("points-raised", text))
        target = MIN_VERTICES
    dense = dense_points(target)
    if request.edge_length > 0:
        check_expected_points(dense, request)
        edge = request.edge_length * math.sqrt(expected / dense)
        return DenseRequest(ResolutionRequest(edge, 0, notes), target, target / dense)
    return DenseRequest(ResolutionRequest(0.0, round(dense), notes), target, target / dense)


def nominal_edge(request: ResolutionRequest, area: float, region: Region) -> float:
    """Return the edge length of the uniform mesh that a request stands for."""
    return EDGE_PER_RADIUS * thinning_radius(request, area, region)
