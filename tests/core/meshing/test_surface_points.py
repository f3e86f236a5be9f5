# SPDX-License-Identifier: GPL-3.0-or-later
"""Pivots on ellipsoids, spacing that photos resolve, requests of an edge length."""

from __future__ import annotations

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
    normal_bases,
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
    times_longer,
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


def test_nine_gof_pivots_are_the_centre_and_the_corners_of_the_box_of_the_axes() -> None:
    arrays = random_arrays(40, 4)
    index = np.array([7, 3, 30])
    pivots = nine_pivots_gof(arrays, index)
    np.testing.assert_array_equal(pivots[:3], arrays.means[index])
    offset = pivots[3:].reshape(3, 8, 3) - arrays.means[index][:, None]
    white = np.einsum("nij,nci->ncj", arrays.rotations[index], offset)
    white /= arrays.scales[index][:, None]
    np.testing.assert_allclose(np.abs(white), 3.0, rtol=1e-9)
    assert all(len(np.unique(np.sign(corners), axis=0)) == 8 for corners in white)


def test_gaussians_that_reach_a_region() -> None:
    means = np.array([[0, 0, 0], [1.2, 0, 0], [1.4, 0, 0], [9, 0, 0], [0.5, 0, 0], [0, 0, 1.25]])
    scales = np.tile([0.1, 0.01, 0.01], (6, 1))
    alphas = np.array([0.9, 0.9, 0.9, 0.9, 0.003, 0.9])
    arrays = make_arrays(means, scales, alphas)
    assert gaussians_reaching(arrays, cube(1.0), 0.0).tolist() == [0, 1]
    assert gaussians_reaching(arrays, cube(1.0), 0.25).tolist() == [0, 1, 2, 5]
    assert gaussians_reaching(arrays, cube(1.0), 0.0, faint=True).tolist() == [0, 1, 4]
    np.testing.assert_allclose(
        directional_sigma(arrays, np.array([0]), np.array([[0.6, 0.8, 0.0]])),
        np.hypot(0.06, 0.008),
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
    # The normal in the plane of the first two axes: sigma is the root of 0.36 0.09 + 0.64 0.04.
    arrays = ellipsoid([0.3, 0.4, 0.0])
    sigma = np.sqrt(0.0324 + 0.0256)
    step = 3 * sigma * np.array([0.6, 0.8, 0.0])
    center = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(two_pivots(arrays, ONLY), [center, center + step], rtol=1e-14)
    np.testing.assert_allclose(
        three_pivots(arrays, ONLY), [center, center + step, center - step], rtol=1e-14
    )


def test_nine_pivots_of_an_ellipsoid_by_hand() -> None:
    # The third axis is the one least aligned with the normal; across both lies (0.8, -0.6, 0),
    # whose sigma is the root of 0.64 0.09 + 0.36 0.04.
    found = nine_pivots(ellipsoid([0.3, 0.4, 0.0]), ONLY)
    center = np.array([1.0, 2.0, 3.0])
    steps = 3.0 * np.array(
        [
            np.sqrt(0.0324 + 0.0256) * np.array([0.6, 0.8, 0.0]),
            [0.0, 0.0, 0.1],
            np.sqrt(0.0576 + 0.0144) * np.array([0.8, -0.6, 0.0]),
        ]
    )
    corners = [
        center + a * steps[0] + b * steps[1] + c * steps[2]
        for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)
    ]  # fmt: skip
    assert as_set(found) == as_set(np.array([center, *corners]))


def test_the_boxes_agree_where_the_normal_is_an_axis_and_differ_elsewhere() -> None:
    turned = Rotation.from_euler("xyz", [0.3, 0.7, 1.1]).as_matrix()
    along = ellipsoid(list(-0.9 * turned[:, 1]), turned)
    assert as_set(nine_pivots(along, ONLY)) == as_set(nine_pivots_gof(along, ONLY))
    without = ellipsoid([0.0, 0.0, 0.0], turned)  # its shortest axis serves as the normal
    assert as_set(nine_pivots(without, ONLY)) == as_set(nine_pivots_gof(without, ONLY))
    across = ellipsoid([0.5, 0.5, 0.5], turned)
    boxes = [rule(across, ONLY)[1:] for rule in (nine_pivots, nine_pivots_gof)]
    assert not as_set(boxes[0]) & as_set(boxes[1])


def test_bases_are_orthonormal_and_begin_with_the_normal() -> None:
    arrays = random_arrays(200, 6)
    arrays.normals[:20] = 0.0
    bases = normal_bases(arrays, np.arange(200))
    identity = np.tile(np.eye(3), (200, 1, 1))
    np.testing.assert_allclose(np.einsum("kij,kil->kjl", bases, bases), identity, atol=1e-12)
    oriented = np.linalg.norm(arrays.normals, axis=1) >= 0.05
    unit = arrays.normals[oriented]
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    np.testing.assert_allclose(bases[oriented, :, 0], unit, atol=1e-12)


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


def test_the_settings_name_the_rule() -> None:
    assert [pivot_rule(number, "normal") for number in PIVOTS] == [
        two_pivots, three_pivots, nine_pivots,
    ]  # fmt: skip
    assert pivot_rule(9, "gof") is nine_pivots_gof
    assert pivot_rule(2, "gof") is two_pivots


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
