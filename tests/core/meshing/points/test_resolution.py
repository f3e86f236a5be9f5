# SPDX-License-Identifier: GPL-3.0-or-later
"""Requests of an edge length: what is refused, and that what a refusal asks for is accepted."""

from __future__ import annotations

import math

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.mesh.sampling import EDGE_PER_RADIUS, POINTS_PER_SQUARE
from gaussian_wrapping_addon.core.meshing.spacing import (
    FINEST_SHARE,
    ResolutionRequest,
    check_expected_points,
    checked_request,
    dense_request,
    times_longer,
)
from tests.core.meshing.meshing_scenes import cube

SIDE = 2.0


@pytest.mark.parametrize("edge_length", [5e-324, 1e-320, 1e-30, 1e-7])
def test_edges_that_no_mesh_has_are_refused(edge_length: float) -> None:
    with pytest.raises(ResourceError, match="edges long: too many") as refused:
        checked_request(edge_length, 0, cube(SIDE))
    assert "a thousandth of the region's diagonal" in refused.value.hint


def test_edges_that_the_refusal_asks_for_are_accepted() -> None:
    region = cube(SIDE)
    request = checked_request(1e-3 * region.diagonal, 0, region)
    assert request.notes == ()
    # A surface as large as the region's own, which few things have.
    dense_request(request, region.area, region)
    checked_request(FINEST_SHARE * region.diagonal, 0, region)


@pytest.mark.parametrize("points", [5.01e6, 5.2e6, 7.3e6, 1.04e7, 9.9e8, 3.3e12])
def test_longer_edges_that_a_refusal_asks_for_are_accepted(points: float) -> None:
    area = 10.0
    edge_length = EDGE_PER_RADIUS * math.sqrt(POINTS_PER_SQUARE * area / points)
    with pytest.raises(ResourceError) as refused:
        check_expected_points(points, ResolutionRequest(edge_length, 0))
    factor = float(refused.value.hint.split("edges ")[1].split(" times")[0])
    longer = ResolutionRequest(edge_length * factor, 0)
    check_expected_points(points / factor**2, longer)
    assert factor < 1.2 * math.sqrt(points / limits.MAX_MESH_POINTS)
    assert factor == float(times_longer(points, limits.MAX_MESH_POINTS))
