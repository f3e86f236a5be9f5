# SPDX-License-Identifier: GPL-3.0-or-later
"""Pivots on ellipsoids, spacing that photos resolve, requests of an edge length."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import MeshingError, ResourceError
from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from gaussian_wrapping_addon.core.mesh.sampling import EDGE_PER_RADIUS, POINTS_PER_SQUARE
from gaussian_wrapping_addon.core.meshing.pivots import (
    PIVOTS,
    directional_sigma,
    gaussians_reaching,
    nine_pivots,
    nine_pivots_gof,
    pivot_rule,
    three_pivots,
    two_pivots,
)
from gaussian_wrapping_addon.core.meshing.spacing import (
    EDGE_PER_PIXEL,
    FINEST_SHARE,
    GRADING,
    ResolutionRequest,
    Spacing,
    check_expected_points,
    checked_request,
    dense_request,
    footprint_spacing,
    footprints,
)
from gaussian_wrapping_addon.core.meshing.surface_points import (
    halo_bounds,
    pivot_cloud,
    pivots_alone,
)
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.field.field_scenes import camera_at, make_arrays, random_arrays, unit_sphere
from tests.core.meshing.meshing_scenes import cube


def test_outer_pivots_lie_three_sigmas_out() -> None:
    arrays = random_arrays(300, 3)
    arrays.normals[:50] *= 1e-3  # not oriented
    index = np.arange(300)
    pivots = two_pivots(arrays, index)
    unoriented = int((np.linalg.norm(arrays.normals, axis=1) < 0.05).sum())
    assert unoriented >= 50
    assert len(pivots) == 600 + unoriented
    offset = pivots[300:600] - arrays.means
    white = np.einsum("nij,ni->nj", arrays.rotations, offset) / arrays.scales
    assert np.linalg.norm(white, axis=1).min() > 3 - 1e-9
    oriented = np.linalg.norm(arrays.normals, axis=1) >= 0.05
    assert ((offset * arrays.normals).sum(1)[oriented] > 0).all()
    np.testing.assert_allclose(
        pivots[600:], 2 * arrays.means[~oriented] - pivots[300:600][~oriented]
    )


def test_gaussians_that_reach_a_region() -> None:
    means = np.array([[0, 0, 0], [1.2, 0, 0], [1.4, 0, 0], [9, 0, 0], [0.5, 0, 0], [0, 0, 1.25]])
    scales = np.tile([0.1, 0.01, 0.01], (6, 1))
    alphas = np.array([0.9, 0.9, 0.9, 0.9, 0.003, 0.9])
    arrays = make_arrays(means, scales, alphas)
    assert gaussians_reaching(arrays, cube(1.0), 0.0).tolist() == [0, 1]
    assert gaussians_reaching(arrays, cube(1.0), 0.25).tolist() == [0, 1, 2, 5]
    assert gaussians_reaching(arrays, cube(1.0), 0.0, faint=True).tolist() == [0, 1, 4]
    np.testing.assert_allclose(
        directional_sigma(arrays, np.array([0]), np.array([[0.6, 0.8, 0.0]])), np.hypot(0.06, 0.008)
    )


def ellipsoid(normal: list[float], rotation: np.ndarray | None = None) -> GaussianArrays:
    """Return one Gaussian at (1, 2, 3) with deviations 0.3, 0.2 and 0.1."""
    return make_arrays(
        np.array([1.0, 2.0, 3.0]), [0.3, 0.2, 0.1], 0.9,
        rotations=None if rotation is None else rotation[None],
        normals=np.array([normal]),
    )  # fmt: skip


ONLY = np.array([0])


def as_set(points: np.ndarray) -> set[tuple[float, ...]]:
    return {tuple(point) for point in np.round(points, 9).tolist()}


def test_pivots_of_an_ellipsoid_by_hand() -> None:
    # The normal lies in the plane of the first two axes, whose third is the one least aligned with
    # it: sigma is the root of 0.36 0.09 + 0.64 0.04. Across both lies (0.8, -0.6, 0).
    arrays = ellipsoid([0.3, 0.4, 0.0])
    center, axes = np.array([1.0, 2.0, 3.0]), 3.0 * np.array([
        np.sqrt(0.0324 + 0.0256) * np.array([0.6, 0.8, 0.0]),
        [0.0, 0.0, 0.1],
        np.sqrt(0.0576 + 0.0144) * np.array([0.8, -0.6, 0.0]),
    ])  # fmt: skip
    outer = center + axes[0]
    for number, expected in ((2, [center, outer]), (3, [center, outer, 2 * center - outer])):
        found = pivot_rule(number, "normal")(arrays, ONLY)
        np.testing.assert_allclose(found, expected, rtol=1e-14)
    corners = [center + axes.T @ signs for signs in itertools.product((-1, 1), repeat=3)]
    found = pivot_rule(9, "normal")(arrays, ONLY)
    assert as_set(found) == as_set(np.array([center, *corners]))
    assert pivot_rule(9, "gof") is nine_pivots_gof
    assert pivot_rule(2, "gof") is two_pivots


def test_the_boxes_agree_where_the_normal_is_an_axis_and_differ_elsewhere() -> None:
    turned = Rotation.from_euler("xyz", [0.3, 0.7, 1.1]).as_matrix()
    along = ellipsoid(list(-0.9 * turned[:, 1]), turned)
    assert as_set(nine_pivots(along, ONLY)) == as_set(nine_pivots_gof(along, ONLY))
    without = ellipsoid([0.0, 0.0, 0.0], turned)  # its shortest axis serves as the normal
    assert as_set(nine_pivots(without, ONLY)) == as_set(nine_pivots_gof(without, ONLY))
    across = ellipsoid([0.5, 0.5, 0.5], turned)
    boxes = [rule(across, ONLY)[1:] for rule in (nine_pivots, nine_pivots_gof)]
    assert not as_set(boxes[0]) & as_set(boxes[1])


@pytest.mark.parametrize("rule", [nine_pivots, nine_pivots_gof, three_pivots, two_pivots])
def test_pivots_turn_and_scale_with_the_scene(rule) -> None:  # type: ignore[no-untyped-def]
    arrays = random_arrays(100, 7)
    arrays.normals[:] /= np.linalg.norm(arrays.normals, axis=1)[:, None]
    turn = Rotation.from_euler("xyz", [1.0, -0.4, 2.0]).as_matrix()
    moved = GaussianArrays(
        50.0 * arrays.means @ turn.T + 7.0, 50.0 * arrays.scales, turn @ arrays.rotations,
        arrays.log_opacities, arrays.normals @ turn.T, arrays.sh,
    )  # fmt: skip
    index = np.arange(100)
    np.testing.assert_allclose(
        rule(moved, index), 50.0 * rule(arrays, index) @ turn.T + 7.0, rtol=1e-9, atol=1e-7
    )


@pytest.mark.parametrize("number", PIVOTS)
def test_pivots_alone_are_those_of_every_gaussian_and_nothing_else(number: int) -> None:
    rng = np.random.default_rng(8)
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    alphas = np.where(np.arange(500) % 2, 0.9, 1e-4)  # every other one too faint to be rendered
    arrays = make_arrays(rng.uniform(-0.9, 0.9, (500, 3)), 0.02, alphas, normals=normals)
    rule = pivot_rule(number, "normal")
    alone = pivots_alone(arrays, cube(1.0), rule)
    np.testing.assert_array_equal(alone.points, rule(arrays, np.arange(500)))
    assert (len(alone.points), alone.gaussians, alone.chosen) == (500 * number, 500, 500)
    usual = pivot_cloud(arrays, cube(1.0), lambda p: p[:, 0] > 0, 0, None, pivots_of=rule)
    assert usual.gaussians == 250
    assert len(usual.points) > 250 * number + 1000, "probes are points as well"


def test_pivots_alone_stay_in_the_halo_and_need_a_gaussian() -> None:
    region = cube(1.0)
    arrays = make_arrays(
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5]]), [5.0, 0.1, 0.1], 0.9,
        normals=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    )  # fmt: skip
    found = pivots_alone(arrays, region, two_pivots).points
    low, high = halo_bounds(region)
    assert ((found >= low) & (found <= high)).all()
    assert len(found) == 3, "the outer pivot of the large one lies beyond"
    far = Region.box("far", np.full(3, 50.0), np.full(3, 51.0))
    with pytest.raises(MeshingError, match="No Gaussian reaches region 'far'"):
        pivots_alone(arrays, far, two_pivots)


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


def test_spacing_is_uniform_where_photos_tell_nothing_and_grows_away_from_what_is_known() -> None:
    camera = camera_at(np.array([0.0, -4.0, 0.0]))
    points = unit_sphere(500)
    for cameras, radius in (([camera], 0.1), ([], 1e-4)):
        spacing = footprint_spacing(points, cameras, radius)
        assert spacing.limited == 0.0
        np.testing.assert_array_equal(spacing.at(points), radius)
    spacing = Spacing(np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([0.1, 0.1]), 0.1, 0.0)
    at = spacing.at(np.array([[0.0, 0, 0], [0.0, 2.0, 0]]))
    assert at == pytest.approx([0.1, 0.1 + GRADING / EDGE_PER_RADIUS * 1.9])


def test_edges_that_no_mesh_has_are_refused_and_those_asked_for_accepted() -> None:
    region = cube(2.0)
    for edge_length in (5e-324, 1e-320, 1e-30, 1e-7):
        with pytest.raises(ResourceError, match="edges long: too many") as refused:
            checked_request(edge_length, 0, region)
        assert "a thousandth of the region's diagonal" in refused.value.hint
    request = checked_request(1e-3 * region.diagonal, 0, region)
    assert request.notes == ()
    # A surface as large as the region's own, which few things have.
    dense_request(request, region.area, region)
    checked_request(FINEST_SHARE * region.diagonal, 0, region)


@pytest.mark.parametrize("points", [5.01e6, 7.3e6, 1.04e7, 3.3e12])
def test_longer_edges_that_a_refusal_asks_for_are_accepted(points: float) -> None:
    edge_length = EDGE_PER_RADIUS * math.sqrt(POINTS_PER_SQUARE * 10.0 / points)
    with pytest.raises(ResourceError) as refused:
        check_expected_points(points, ResolutionRequest(edge_length, 0))
    factor = float(refused.value.hint.split("edges ")[1].split(" times")[0])
    check_expected_points(points / factor**2, ResolutionRequest(edge_length * factor, 0))
    assert factor < 1.2 * math.sqrt(points / limits.MAX_MESH_POINTS)
