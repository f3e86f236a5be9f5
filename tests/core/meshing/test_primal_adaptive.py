# SPDX-License-Identifier: GPL-3.0-or-later
"""Primal adaptive meshing of known shapes."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled, MeshingError, ResourceError, UsageError
from gaussian_wrapping_addon.core.field.vacancy import VacancyResult
from gaussian_wrapping_addon.core.mesh.sampling import sample_triangles
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh, area_vectors
from gaussian_wrapping_addon.core.meshing import surface_points
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.spacing import MIN_VERTICES
from gaussian_wrapping_addon.core.meshing.surface_points import Field
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.field.field_scenes import camera_at
from tests.core.meshing.meshing_scenes import (
    Distance,
    ShapeField,
    assert_closed_manifold,
    cube,
    gaussians_on,
    rounded_box,
    settings,
    some_cameras,
    sphere,
    torus,
)


def mesh_shape(
    shape: Distance | ShapeField,
    region: Region,
    *,
    points: int = 0,
    edge: float = 0.0,
    sigma: float = 0.02,
    share: float = 0.01,
    threads: int = 1,
    spacing: str = "adaptive",
    progress: Progress | None = None,
    around: Region | None = None,
) -> SurfaceMesh:
    field = shape if isinstance(shape, ShapeField) else ShapeField(shape, sigma)
    arrays = gaussians_on(field.distance, around or region, 800, sigma)
    return mesh_region(
        Field(field, field, threads), arrays, some_cameras(), region,
        settings(points, share, spacing), progress or Progress(), seed=0, edge_length_scene=edge,
    )  # fmt: skip


def test_a_request_for_too_few_points_is_said() -> None:
    for points, said in ((1, True), (99, True), (100, False)):
        mesh = mesh_shape(sphere(), cube(1.3), points=points)
        notes = " ".join(n["text"] for n in mesh.provenance["notes"])
        assert (f"surface points; {points} were requested" in notes) == said
        assert len(mesh.vertices) >= MIN_VERTICES - 4
    uniform = mesh_shape(sphere(), cube(1.3), points=60, spacing="uniform")
    assert "surface points" not in " ".join(n["text"] for n in uniform.provenance["notes"])


def test_sphere_is_closed_of_genus_0_and_on_the_surface() -> None:
    mesh = mesh_shape(sphere(), cube(1.3), points=2500)
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.genus, figures.euler) == (1, 0, 2)
    # 0.01 of vacancy is 0.04 sigma of distance for a logistic flank.
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.045 * 0.02
    centres = np.linalg.norm(mesh.vertices[mesh.faces].mean(1), axis=1)
    assert centres.max() < 1 + 0.045 * 0.02
    assert centres.min() > 1 - mesh.provenance["edge_length_scene"] ** 2
    assert figures.volume == pytest.approx(4 / 3 * np.pi, rel=0.01)
    assert 0.7 * 2500 < figures.vertices < 1.3 * 2500
    assert mesh.provenance["level_error_max"] <= 0.01 + 1e-6
    normals = area_vectors(mesh.vertices, mesh.faces)
    assert ((normals * mesh.vertices[mesh.faces].mean(1)).sum(1) > 0).all()


def test_torus_has_genus_1_and_even_triangles() -> None:
    mesh = mesh_shape(torus(), cube(1.5), edge=0.08, spacing="uniform")
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.genus) == (1, 1)
    assert figures.volume == pytest.approx(2 * np.pi**2 * 0.35**2, rel=0.02)
    assert figures.mean_edge == pytest.approx(0.08, rel=0.12)
    corners = mesh.vertices[mesh.faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert edges.max() < 4 * 0.08
    assert np.median(edges.min(1) / edges.max(1)) > 0.6


WIRE_VOLUME = np.pi * 0.03**2 * 1.74 + 4 / 3 * np.pi * 0.03**3


@pytest.mark.parametrize(
    ("half", "rounding", "request_", "sigma", "volume", "error"),
    [
        ((0.8, 0.8, 0.02), 0.019, {"edge": 0.1}, 0.004, 1.6 * 1.6 * 0.04, 0.06),
        ((0.8, 0.8, 0.005), 0.0049, {"points": 3000}, 0.001, 1.6 * 1.6 * 0.01, 0.08),
        ((0.9, 0.03, 0.03), 0.0299, {"edge": 0.06}, 0.004, WIRE_VOLUME, 0.2),
    ],
    ids=["plate", "plate of half a percent of the region", "wire"],
)
def test_what_is_thinner_than_an_edge_stays_whole(
    half: tuple[float, float, float], rounding: float, request_: dict, sigma: float,
    volume: float, error: float,
) -> None:  # fmt: skip
    mesh = mesh_shape(rounded_box(half, rounding), cube(1.0), sigma=sigma, **request_)
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.genus) == (1, 0)
    assert figures.volume == pytest.approx(volume, rel=error)


def test_adaptive_spacing_halves_the_vertices_of_a_rounded_box() -> None:
    box = rounded_box((0.8, 0.6, 0.5), 0.15)
    errors = []
    for points, spacing in ((2000, "uniform"), (1000, "adaptive")):
        mesh = mesh_shape(box, cube(1.0), points=points, spacing=spacing)
        assert assert_closed_manifold(mesh).genus == 0
        drawn, _ = sample_triangles(mesh.vertices, mesh.faces, 50_000, np.random.default_rng(0))
        away = np.abs(box(drawn))
        errors.append((away.mean(), np.quantile(away, 0.99)))
    assert errors[1] < errors[0]
    assert errors[1][1] < errors[0][1]


def test_region_that_cuts_the_solid_closes_it() -> None:
    region = Region.box("cut", [-1.3, -1.3, -1.3], [1.3, 1.3, 0.4])
    mesh = mesh_shape(sphere(), region, points=2500)
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.genus) == (1, 0)
    assert region.contains(mesh.vertices, 1e-9).all()
    cap = 0.6**2 * (3 - 0.6) * np.pi / 3  # the cap above z = 0.4 is missing
    assert figures.volume == pytest.approx(4 / 3 * np.pi - cap, rel=0.01)
    assert mesh.provenance["vertices_on_region_boundary"] > 50
    on_plane = mesh.vertices[np.abs(mesh.vertices[:, 2] - 0.4) < 1e-9]
    # The rim runs along the exact circle.
    assert np.hypot(*on_plane[:, :2].T).max() == pytest.approx(np.sqrt(1 - 0.4**2), abs=2e-3)


def test_turned_region_inside_the_solid_gives_the_region() -> None:
    rotation = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    region = Region.box("corner", [0.2, 0.2, 0.2], [0.8, 0.9, 1.0], rotation)
    mesh = mesh_shape(sphere(1.2), region, edge=0.06)
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.genus) == (1, 0)
    rng = np.random.default_rng(0)
    samples = rng.uniform([0.2, 0.2, 0.2], [0.8, 0.9, 1.0], (400_000, 3))
    share = (np.linalg.norm(samples, axis=1) < 1.2).mean()
    assert figures.volume == pytest.approx(share * 0.6 * 0.7 * 0.8, rel=0.01)


class HalfSeen(ShapeField):
    """No camera sees anything beyond x = 0.3."""

    def vacancy(self, points: np.ndarray) -> VacancyResult:
        found = super().vacancy(points)
        unseen = points[:, 0] > 0.3
        return VacancyResult(
            np.where(unseen, np.float32(1), found.vacancy), np.where(unseen, -1, found.camera)
        )


def test_solid_ends_with_a_flat_wall_where_sight_ends() -> None:
    mesh = mesh_shape(HalfSeen(sphere(), 0.02), cube(1.3), points=2000)
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.genus) == (1, 0)
    missing = 0.7**2 * (3 - 0.7) * np.pi / 3
    assert figures.volume == pytest.approx(4 / 3 * np.pi - missing, rel=0.02)
    assert mesh.vertices[:, 0].max() < 0.3 + 0.01
    assert mesh.provenance["vertices_at_end_of_sight"] > 30


@pytest.mark.parametrize(("share", "removed"), [(0.05, 1), (0.0, 0)])
def test_two_touching_solids_and_a_floater(share: float, removed: int) -> None:
    def distance(p: np.ndarray) -> np.ndarray:
        shifted = [np.linalg.norm(p - [x, 0, 0], axis=1) - 0.5 for x in (-0.49, 0.49)]
        floater = np.linalg.norm(p - [0, 0, 0.9], axis=1) - 0.04
        return np.minimum(np.minimum(*shifted), floater)

    mesh = mesh_shape(distance, cube(1.1), edge=0.05, sigma=0.01, share=share)
    assert assert_closed_manifold(mesh).components == 2 - removed
    assert mesh.provenance["removed_solids"] == removed


@functools.lru_cache(maxsize=1)
def small_torus() -> SurfaceMesh:
    return mesh_shape(torus(), cube(1.5), points=800)


def test_same_seed_gives_the_same_mesh_for_any_threads() -> None:
    again = mesh_shape(torus(), cube(1.5), points=800, threads=2)
    np.testing.assert_array_equal(again.vertices, small_torus().vertices)
    np.testing.assert_array_equal(again.faces, small_torus().faces)
    assert again.provenance == small_torus().provenance


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_scale_invariance(scale: float) -> None:
    region = Region.box("cube", np.full(3, -1.5 * scale), np.full(3, 1.5 * scale))
    field = ShapeField(lambda p: scale * torus()(p / scale), 0.02 * scale)
    arrays = gaussians_on(torus(), cube(1.5), 800, 0.02)
    arrays = dataclasses.replace(arrays, means=scale * arrays.means, scales=scale * arrays.scales)
    cameras = [camera_at(scale * np.array([0.0, -5.0, 1.0]))]
    other = mesh_region(
        Field(field, field, 1), arrays, cameras, region, settings(800), Progress(), seed=0
    )
    figures, small = assert_closed_manifold(other), assert_closed_manifold(small_torus())
    assert (figures.genus, figures.components) == (small.genus, small.components) == (1, 1)
    # Which samples are drawn hangs on the last bit; the surface does not.
    assert np.abs(torus()(other.vertices / scale)).max() < 1e-4 * cube(1.5).diagonal * 2
    assert figures.vertices == pytest.approx(small.vertices, rel=0.05)
    assert figures.volume / scale**3 == pytest.approx(small.volume, rel=5e-3)


@pytest.mark.proof
def test_automatic_density_gives_tens_of_thousands_of_faces() -> None:
    mesh = mesh_shape(sphere(), cube(1.3))
    figures = assert_closed_manifold(mesh)
    assert 30_000 < figures.faces < 60_000
    assert figures.genus == 0


def test_candidates_drawn_in_blocks_give_as_good_a_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_points, "MAX_BLOCK", 3000)
    figures = assert_closed_manifold(mesh_shape(torus(), cube(1.5), points=800))
    whole = assert_closed_manifold(small_torus())
    assert figures.genus == 1
    assert figures.vertices == pytest.approx(whole.vertices, rel=0.05)
    assert figures.mean_edge == pytest.approx(whole.mean_edge, rel=0.03)


def test_empty_region_and_region_without_gaussians() -> None:
    nowhere = Region.box("air", np.full(3, 5.0), np.full(3, 6.0))
    nothing = ShapeField(sphere(), 0.02)
    nothing.vacancy = ShapeField(lambda p: np.ones(len(p)), 0.02).vacancy  # type: ignore[method-assign]
    for region, field, text in (
        (nowhere, ShapeField(sphere(), 0.02), "No Gaussian reaches region 'air'"),
        (cube(1.3), nothing, "no surface"),
    ):
        with pytest.raises(MeshingError, match=text) as caught:
            mesh_shape(field, region, points=500, around=cube(1.3))
        assert caught.value.hint


@pytest.mark.parametrize(
    ("edge", "points", "error"),
    [
        (-1.0, 0, UsageError),
        (float("nan"), 0, UsageError),
        (0.1, 100, UsageError),
        (1e-9, 0, ResourceError),
        (0.0, 10**9, ResourceError),
    ],
)
def test_absurd_requests_are_refused(edge: float, points: int, error: type[Exception]) -> None:
    with pytest.raises(error) as caught:
        mesh_shape(sphere(), cube(1.3), edge=edge, points=points)
    assert caught.value.hint  # type: ignore[attr-defined]


def test_edge_longer_than_the_region_is_reduced_and_said() -> None:
    mesh = mesh_shape(sphere(), cube(1.3), edge=100.0)
    assert_closed_manifold(mesh)
    assert any("reduced" in note["text"] for note in mesh.provenance["notes"])
    assert mesh.provenance["edge_length_scene"] == pytest.approx(cube(1.3).diagonal / 8)


def test_progress_grows_and_cancelling_stops() -> None:
    events: list[ProgressEvent] = []
    mesh_shape(sphere(), cube(1.3), points=500, progress=Progress("mesh", events.append))
    fractions = [e.fraction for e in events]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    seen: list[ProgressEvent] = []
    stop = Progress("mesh", seen.append, lambda: len(seen) >= 5)
    with pytest.raises(Cancelled):
        mesh_shape(sphere(), cube(1.3), points=500, progress=stop)
    assert len(seen) == 5
