# SPDX-License-Identifier: GPL-3.0-or-later
"""Pivot meshing of known shapes: closed at the region, on the surface, correct topology."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing import pivot_meshing
from gaussian_wrapping_addon.core.meshing.checks import mesh_statistics, validate_manifold
from gaussian_wrapping_addon.core.meshing.clean_up import without_caps
from gaussian_wrapping_addon.core.meshing.pivot_meshing import BRACKET_SHARE, mesh_by_pivots
from gaussian_wrapping_addon.core.meshing.pivots import PIVOTS, pivot_rule
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.field.field_scenes import make_arrays
from tests.core.meshing.meshing_scenes import (
    Distance,
    ShapeField,
    assert_closed_manifold,
    cube,
    gaussians_on,
    rounded_box,
    some_cameras,
    sphere,
    torus,
)

SIGMA = 0.05
TURNED = Rotation.from_euler("xyz", [0.3, 0.7, 1.1]).as_matrix()


def mesh_of(
    distance: Distance, region: Region, *, pivots: int = 2, count: int = 1200, sigma: float = SIGMA,
    around: Region | None = None, cameras: list[Camera] | None = None, **changes: float | str,
) -> SurfaceMesh:  # fmt: skip
    arrays = gaussians_on(distance, around or region, count, sigma)
    field = ShapeField(distance, sigma)
    settings = replace(MeshingSettings(method="pivots", pivots=pivots), **changes)
    return mesh_by_pivots(
        field, arrays, cameras or some_cameras(), region, settings, Progress(), seed=0
    )


def assert_good(mesh: SurfaceMesh) -> None:
    assert_closed_manifold(mesh)
    assert validate_manifold(mesh.vertices, mesh.faces).defects() == []


def volume_of(mesh: SurfaceMesh) -> float:
    return validate_manifold(mesh.vertices, mesh.faces).volume


@pytest.mark.parametrize("pivots", PIVOTS)
@pytest.mark.parametrize(("shape", "genus"), [(sphere, 0), (torus, 1)])
def test_whole_shapes(shape: Callable[[], Distance], genus: int, pivots: int) -> None:
    mesh = mesh_of(shape(), cube(1.5), pivots=pivots)
    assert_good(mesh)
    assert [part.genus for part in validate_manifold(mesh.vertices, mesh.faces).parts] == [genus]
    assert np.quantile(np.abs(shape()(mesh.vertices)), 0.99) < 0.03 * SIGMA
    assert mesh.provenance["pivots_each"] == pivots
    assert mesh.provenance["level_error_p99"] < 0.02
    assert mesh.provenance["vertices_on_region_boundary"] == 0


@pytest.mark.parametrize(("pivots", "box"), [(2, "normal"), (9, "normal"), (9, "gof")])
def test_pivots_alone_give_a_closed_mesh_of_their_own_points(
    pivots: int, box: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    triangulated = []
    honest = pivot_meshing.delaunay

    def watched(points: np.ndarray, **named: object) -> np.ndarray:
        triangulated.append(points.copy())
        return honest(points, **named)

    monkeypatch.setattr(pivot_meshing, "delaunay", watched)
    mesh = mesh_of(sphere(), cube(1.5), pivots=pivots, pivot_box=box, pivot_samples="none")
    assert_good(mesh)
    arrays = gaussians_on(sphere(), cube(1.5), 1200, SIGMA)
    count = len(arrays.means)
    own = pivot_rule(pivots, box)(arrays, np.arange(count))
    np.testing.assert_array_equal(triangulated[0][:-8], own)  # and the eight bounding points
    figures = mesh.provenance
    assert figures["pivots"] == len(own) == pivots * count
    assert (figures["sightings"], figures["gaussians_in_region"]) == (0, count)
    assert (figures["pivot_samples"], figures["pivot_box"]) == ("none", box if pivots == 9 else "")
    assert np.quantile(np.abs(sphere()(mesh.vertices)), 0.99) < 0.03 * SIGMA


@pytest.mark.parametrize("pivots", PIVOTS)
def test_a_cut_sphere_ends_on_the_planes_with_the_exact_volume(pivots: int) -> None:
    # A quarter of the ball: two planes through its centre meet at a sharp edge inside of it.
    low, high = np.array([0.0, 0.0, -1.5]), np.array([1.5, 1.5, 1.5])
    region = Region.box("quarter", low, high, TURNED)
    mesh = mesh_of(sphere(), region, pivots=pivots, count=2500)
    assert_good(mesh)
    assert mesh.provenance["degenerate_faces_left"] <= 1e-3 * len(mesh.faces) * (pivots == 9)
    assert region.distance(mesh.vertices).max() <= 1e-12
    local = mesh.vertices @ TURNED
    on_plane = np.isclose(local[:, :2], 0.0, atol=1e-12)
    edge = local[on_plane.all(1), 2]
    assert edge.min() == pytest.approx(-1.0, abs=0.01), "the sharp edge reaches the surface"
    assert edge.max() == pytest.approx(1.0, abs=0.01)
    off_caps = ~on_plane.any(1)
    assert np.abs(sphere()(mesh.vertices[off_caps])).max() < 0.1 * SIGMA
    assert volume_of(mesh) == pytest.approx(np.pi / 3, rel=0.02)


def test_a_plate_that_the_region_cuts_on_all_sides() -> None:
    plate = rounded_box((4.0, 4.0, 0.02), 0.01)
    region = Region.box("cut", np.array([-1, -1, -0.5]), np.array([1, 1, 0.5]))
    mesh = mesh_of(plate, region, sigma=0.01, count=3000)
    assert_good(mesh)
    assert volume_of(mesh) == pytest.approx(2 * 2 * 0.04, rel=0.03)


def test_a_solid_that_fills_the_corner_of_the_region_gets_that_corner() -> None:
    mesh = mesh_of(sphere(), Region.box("corner", np.zeros(3), np.full(3, 2.0)), count=2500)
    assert_good(mesh)
    assert np.linalg.norm(mesh.vertices, axis=1).min() < 1e-9
    assert volume_of(mesh) == pytest.approx(np.pi / 6, rel=0.02)


def test_a_solid_that_touches_the_corner_of_the_region() -> None:
    # The corner lies on the sphere, up to rounding.
    corner = np.full(3, 1 / np.sqrt(3))
    region = Region.box("touch", corner - 3.0, corner)
    mesh = mesh_of(sphere(), region, around=cube(1.5))
    assert_good(mesh)
    assert region.distance(mesh.vertices).max() <= 1e-12


def test_iso_value_exactly_on_pivots() -> None:
    # All centres lie on the plane z = 0 exactly, which is where the surface is.
    axis = np.linspace(-1.4, 1.4, 15)
    x, y = np.meshgrid(axis, axis)
    centres = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    normals = np.tile([0.0, 0.0, 0.95], (x.size, 1))
    arrays = make_arrays(centres, SIGMA, 0.95, normals=normals)
    for empty_at_level in (False, True):
        field = ShapeField(lambda p: p[:, 2], SIGMA)
        if empty_at_level:
            field.is_empty = lambda p: p[:, 2] >= 0.0  # type: ignore[method-assign]
        mesh = mesh_by_pivots(
            field, arrays, some_cameras(), cube(1.0), MeshingSettings(method="pivots"),
            Progress(), seed=0,
        )  # fmt: skip
        assert_good(mesh)
        assert volume_of(mesh) == pytest.approx(4.0, rel=0.02)


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_the_same_mesh_at_any_scale(scale: float) -> None:
    region = Region.box("half", np.array([0.1, -1.5, -1.5]), np.array([1.5, 1.5, 1.5]), TURNED)
    plain = mesh_of(sphere(), region, cameras=[far_camera(1.0)])
    scaled = mesh_of(
        lambda p: sphere()(p / scale) * scale, Region("half", region.vertices * scale),
        sigma=SIGMA * scale, cameras=[far_camera(scale)],
    )  # fmt: skip
    assert_good(scaled)
    assert len(scaled.faces) == pytest.approx(len(plain.faces), rel=0.01)
    assert volume_of(scaled) / scale**3 == pytest.approx(volume_of(plain), rel=1e-3)


def far_camera(scale: float) -> Camera:
    camera = some_cameras()[0]
    pose = camera.cam_from_world * np.array([1.0, 1.0, 1.0, scale])
    return replace(camera, cam_from_world=pose)


def test_brackets_follow_pixels_and_edges() -> None:
    # A camera that resolves finely needs more evaluations, and leaves less error.
    near = mesh_of(sphere(), cube(1.5))
    fine = replace(some_cameras()[0], fx=1e5, fy=1e5, width=10**5, height=10**5, cx=5e4, cy=5e4)
    finer = mesh_of(sphere(), cube(1.5), cameras=[fine])
    off = [np.abs(sphere()(m.vertices)).max() for m in (near, finer)]
    assert off[1] < 0.2 * off[0]
    assert off[1] <= 1.01 * BRACKET_SHARE * (6.0 / 1e5) / 2


def test_open_and_closed_share_the_surface() -> None:
    region = Region.box("half", np.array([0.0, -1.5, -1.5]), np.array([1.5, 1.5, 1.5]), TURNED)
    whole = mesh_of(sphere(), region)
    for mesh, cut, area in (
        (whole, None, 3 * np.pi),
        (without_caps(whole, region), region, 2 * np.pi),
    ):
        check = validate_manifold(mesh.vertices, mesh.faces, cut)
        assert check.defects() == []
        assert (check.open_edges == 0) == (cut is None)
        assert mesh_statistics(mesh).area == pytest.approx(area, rel=0.02)


def test_requests_that_do_not_apply_are_told() -> None:
    assert mesh_of(sphere(), cube(1.5)).provenance["notes"] == []
    (note,) = mesh_of(sphere(), cube(1.5), points=500).provenance["notes"]
    assert "resolution" in note["text"]


def test_regions_without_surface_get_an_answer() -> None:
    arrays = gaussians_on(sphere(), cube(1.5), 500, SIGMA)
    empty, field = ShapeField(lambda p: np.ones(len(p)), SIGMA), ShapeField(sphere(), SIGMA)
    elsewhere = Region.box("elsewhere", np.full(3, 50.0), np.full(3, 51.0))
    for given, cameras, region, words in (
        (empty, some_cameras(), cube(1.5), "holds no surface"),
        (field, some_cameras(), elsewhere, "No Gaussian reaches region 'elsewhere'"),
        (field, [], cube(1.5), "no cameras"),
    ):
        with pytest.raises(MeshingError, match=words):
            mesh_by_pivots(
                given, arrays, cameras, region, MeshingSettings(method="pivots"), Progress(), seed=0
            )


@pytest.mark.parametrize(("share", "components"), [(0.0, 2), (0.03, 1)])
def test_a_solid_of_a_hundred_times_less_is_a_floater(share: float, components: int) -> None:
    mesh = mesh_of(
        lambda p: np.minimum(sphere()(p), sphere(0.05)(p - np.array([1.3, 0, 0]))), cube(1.5),
        sigma=0.02, count=4000, min_component_share=share,
    )  # fmt: skip
    assert_good(mesh)
    figures = mesh.provenance
    assert (figures["components"], figures["removed_solids"]) == (components, 2 - components)
