# SPDX-License-Identifier: GPL-3.0-or-later
"""Spacing limited by what the photos resolve, and graded."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.sampling import EDGE_PER_RADIUS
from gaussian_wrapping_addon.core.meshing.spacing import (
    EDGE_PER_PIXEL,
    GRADING,
    Spacing,
    footprint_spacing,
    footprints,
)
from tests.core.field.field_scenes import camera_at, unit_sphere


def test_footprint_is_that_of_the_camera_that_shows_a_point_largest() -> None:
    near, far = camera_at(np.array([0.0, -4.0, 0.0])), camera_at(np.array([0.0, -8.0, 0.0]))
    points = np.array([[0.0, 0.0, 0.0], [0.0, -6.0, 0.0], [0.0, -9.0, 0.0]])
    expected = np.array([4.0, 2.0, 0.0]) / near.fy  # the last lies behind both
    np.testing.assert_allclose(footprints(points, [far, near]), expected, rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_edges_are_not_shorter_than_half_a_pixel_and_change_slowly(scale: float) -> None:
    camera = camera_at(np.array([0.0, -4.0, 0.0]) * scale)
    points = unit_sphere(4000) * scale
    radius = 1e-3 * scale
    spacing = footprint_spacing(points, [camera], radius)
    assert spacing.limited == pytest.approx(1.0)
    resolved = EDGE_PER_PIXEL * footprints(points, [camera])
    edges = EDGE_PER_RADIUS * spacing.at(points)
    np.testing.assert_allclose(edges, resolved, rtol=0.01)
    steps = np.abs(edges[:, None] - edges[None, :500])
    apart = np.linalg.norm(points[:, None] - points[None, :500], axis=2)
    assert (steps <= GRADING * apart + 0.02 * resolved.max()).all()


def test_coarse_edges_and_absent_cameras_leave_the_spacing_uniform() -> None:
    camera = camera_at(np.array([0.0, -4.0, 0.0]))
    points = unit_sphere(500)
    for cameras, radius in (([camera], 0.1), ([], 1e-4)):
        spacing = footprint_spacing(points, cameras, radius)
        assert spacing.limited == 0.0
        np.testing.assert_array_equal(spacing.at(points), radius)


def test_spacing_grows_away_from_where_it_is_known() -> None:
    spacing = Spacing(np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([0.1, 0.1]), 0.1, 0.0)
    at = spacing.at(np.array([[0.0, 0, 0], [0.0, 2.0, 0]]))
    assert at[0] == pytest.approx(0.1)
    assert at[1] == pytest.approx(0.1 + GRADING / EDGE_PER_RADIUS * 1.9)
