# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimates of meshes: ranges contain what is measured; what cannot fit is refused."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError, ResourceError
from gaussian_wrapping_addon.core.meshing.estimate import (
    AREA_HIGH,
    AREA_LOW,
    BASE_BYTES,
    MeshEstimate,
    box_counting_area,
    estimate_mesh,
    estimate_pivot_mesh,
    occupied_boundary_area,
    two_digits_below,
)
from gaussian_wrapping_addon.core.meshing.pivot_meshing import mesh_by_pivots
from gaussian_wrapping_addon.core.meshing.pivots import PIVOTS
from gaussian_wrapping_addon.core.meshing.spacing import ResolutionRequest, resolved_edges
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.meshing.meshing_scenes import (
    ShapeField,
    cube,
    gaussians_on,
    some_cameras,
    sphere,
    torus,
)
from tests.core.meshing.test_tiles import SIGMA
from tests.core.meshing.tiled_meshing import mesh_in_tiles
from tests.proofs import first_then_proofs


def on_ball(count: int) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


@pytest.mark.parametrize("count", [2000, 60_000])
@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_area_of_a_ball_and_a_tilted_plane(count: int, scale: float) -> None:
    found = box_counting_area(scale * on_ball(count) + 7.0 * scale)
    assert AREA_LOW < 4 * np.pi * scale**2 / found < AREA_HIGH
    axes = np.array([[0.6, 0.0, 0.8], [0.48, 0.8, -0.36]])
    plane = np.random.default_rng(1).uniform(0, 1, (count, 2)) @ axes
    assert AREA_LOW < scale**2 / box_counting_area(scale * plane) < AREA_HIGH
    for points in (np.zeros((0, 3)), np.ones((5, 3)), np.ones((500, 3))):
        assert box_counting_area(points) == 0.0


def test_boundary_in_the_solid() -> None:
    field = ShapeField(lambda p: p[:, 2] - 0.5, 0.01)  # solid below z = 0.5
    region = Region.box("box", np.zeros(3), np.ones(3))
    assert occupied_boundary_area(region, field.is_empty) == pytest.approx(1 + 4 * 0.5, rel=0.03)


@pytest.mark.parametrize(
    ("request_", "spacing", "widest"),
    [
        (ResolutionRequest(0.08, 0), "uniform", 5), (ResolutionRequest(0.0, 3000), "uniform", 5),
        (ResolutionRequest(0.12, 0), "adaptive", 3.5), (ResolutionRequest(0, 800), "adaptive", 3.5),
    ],
)  # fmt: skip
def test_range_holds_the_mesh(request_: ResolutionRequest, spacing: str, widest: float) -> None:
    adaptive = spacing == "adaptive"
    field = ShapeField(sphere(), SIGMA)
    region = Region.box("half", np.array([-1.3, -1.3, 0.1]), np.full(3, 1.3))
    upper = on_ball(40_000)
    upper = upper[region.contains(upper)]
    cap_area = occupied_boundary_area(region, field.is_empty)
    assert cap_area == pytest.approx(np.pi * 0.99, rel=0.1)
    resolved = resolved_edges(upper[::8], some_cameras()) if adaptive else None
    expected = estimate_mesh(
        box_counting_area(upper), cap_area, request_, adaptive=adaptive, resolved=resolved
    )
    mesh = mesh_in_tiles(
        field, field, gaussians_on(sphere(), region, 800, SIGMA), some_cameras(), region,
        MeshingSettings(points=request_.points, spacing=spacing), Progress(), tiles=1 + adaptive,
        seed=0, threads=1, edge_length_scene=request_.edge_length,
    )  # fmt: skip
    assert expected.points_low < len(mesh.vertices) < expected.points_high
    assert expected.points_high < widest * expected.points_low
    if adaptive:
        assert expected.dense_low < mesh.provenance["dense_vertices"] < expected.dense_high
        assert expected.dense_high < 5 * expected.dense_low


def test_photos_that_resolve_less_lower_the_least() -> None:
    request = ResolutionRequest(0.01, 0)
    sharp, blurred = (
        estimate_mesh(10.0, 0.0, request, adaptive=True, resolved=np.full(9, edge))
        for edge in (1e-4, 0.05)
    )
    assert blurred.dense_low < 0.05 * sharp.dense_low
    assert blurred.dense_high == sharp.dense_high
    assert blurred.points_low <= blurred.dense_low


def test_region_within_the_solid_or_in_empty_space() -> None:
    for edge, points in ((0.0, 0), (0.0, 1000), (0.01, 0)):
        within = estimate_mesh(0.0, 6.0, ResolutionRequest(edge, points), adaptive=True)
        assert 0 <= within.points_low <= within.points_high
        assert within.points_high > 0
        nothing = estimate_mesh(0.0, 0.0, ResolutionRequest(edge, points), adaptive=False)
        assert nothing.points_low <= nothing.points_high


def test_finer_edges_cost_in_proportion_to_the_points() -> None:
    coarse = estimate_mesh(10.0, 0.0, ResolutionRequest(0.02, 0), adaptive=False, evaluation_s=1e-5)
    fine = estimate_mesh(10.0, 0.0, ResolutionRequest(0.01, 0), adaptive=False, evaluation_s=1e-5)
    assert fine.points_high == pytest.approx(4 * coarse.points_high, rel=0.01)
    assert fine.seconds_high < 4 * coarse.seconds_high
    ratio = (fine.memory_bytes - BASE_BYTES) / (coarse.memory_bytes - BASE_BYTES)
    assert ratio == pytest.approx(4, rel=0.01)
    finest = estimate_mesh(10.0, 0.0, ResolutionRequest(0.002, 0), adaptive=False)
    assert finest.tiled_memory_bytes < finest.memory_low_bytes


def of_area(edge: float, points: int = 0, *, adaptive: bool) -> MeshEstimate:
    return estimate_mesh(10.0, 0.0, ResolutionRequest(edge, points), adaptive=adaptive)


def test_adaptive_spacing_counts_the_mesh_from_which_it_selects() -> None:
    for edge in (0.03, 0.004):
        uniform, adaptive = of_area(edge, adaptive=False), of_area(edge, adaptive=True)
        assert adaptive.points_high == pytest.approx(0.5 * uniform.points_high, rel=0.01)
        assert adaptive.dense_low >= 2 * adaptive.points_low - 1
        assert adaptive.memory_bytes >= uniform.memory_bytes - 1e4
    # A number of points may be any that the settings allow: memory decides.
    of_area(0.0, 5_000_000, adaptive=True).refuse(0, tiled=True)


@pytest.mark.parametrize("adaptive", [False, True])
def test_what_a_refusal_asks_for_fits(adaptive: bool) -> None:
    with pytest.raises(ResourceError) as refused:
        of_area(0.002, adaptive=adaptive).refuse(2 << 30, tiled=True)
    factor = float(refused.value.hint.split("edges ")[1].split(" times")[0])
    of_area(0.002 * factor, adaptive=adaptive).refuse(2 << 30, tiled=True)
    most = refused.value.hint.split("at most ")[1].split(" points")[0]
    of_area(0.0, int(most.replace(" ", "")), adaptive=adaptive).refuse(2 << 30, tiled=True)


@pytest.mark.parametrize(("number", "said"), [
    (0, "0"), (7, "7"), (109, "100"), (2_559_999, "2 500 000"), (999_999, "990 000"),
])  # fmt: skip
def test_numbers_that_a_refusal_asks_for_are_rounded_down(number: int, said: str) -> None:
    assert two_digits_below(number) == said


def test_what_cannot_fit_is_refused() -> None:
    with pytest.raises(ResourceError, match="the limit is"):
        of_area(0.0009, adaptive=False).refuse(0, tiled=True)
    expected = of_area(0.002, adaptive=False)
    expected.refuse(0, tiled=False)  # unknown memory refuses nothing
    expected.refuse(1 << 50, tiled=False)
    with pytest.raises(ResourceError, match=r"times longer .*, or tiles"):
        expected.refuse(expected.tiled_memory_bytes, tiled=False)
    expected.refuse(expected.tiled_memory_bytes, tiled=True)
    with pytest.raises(ResourceError, match="Close other programs"):
        expected.refuse(BASE_BYTES, tiled=True)
    assert expected.tiles_for(0)
    small = of_area(0.05, adaptive=False)
    assert not small.tiles_for(0)
    assert small.tiles_for(BASE_BYTES)


PIVOT_SIGMA = 0.05
HALF = Region.box("half", np.array([-0.1, -2, -2]), np.array([2, 2, 2]))


@pytest.mark.parametrize("pivots", PIVOTS)
@pytest.mark.parametrize("region", [cube(1.5), HALF], ids=["whole", "half"])
@pytest.mark.parametrize("shape", first_then_proofs([sphere, torus]))
@pytest.mark.parametrize("samples", first_then_proofs(["depth", "none"]))
def test_ranges_hold_the_mesh(shape, region: Region, pivots: int, samples: str) -> None:
    arrays = gaussians_on(shape(), cube(1.5), 4000, PIVOT_SIGMA)
    expected = estimate_pivot_mesh(arrays, region, pivots, 0, alone=samples == "none")
    settings = MeshingSettings(method="pivots", pivots=pivots, pivot_samples=samples)
    field = ShapeField(shape(), PIVOT_SIGMA)
    mesh = mesh_by_pivots(field, arrays, some_cameras(), region, settings, Progress(), seed=0)
    figures = mesh.provenance
    assert expected.gaussians == figures["gaussians_in_region"]
    assert expected.pivots_low == expected.pivots_high == figures["pivots"]
    assert expected.tetrahedra_low < figures["tetrahedra"] < expected.tetrahedra_high
    assert expected.points_low < len(mesh.vertices) < expected.points_high


def test_more_pivots_and_sightings_cost_more() -> None:
    arrays = gaussians_on(sphere(), cube(1.5), 4000, PIVOT_SIGMA)
    two, nine = (estimate_pivot_mesh(arrays, cube(1.5), k, 0, evaluation_s=1e-5) for k in (2, 9))
    assert nine.tetrahedra_high > 2 * two.tetrahedra_high
    assert nine.memory_low_bytes > two.memory_low_bytes
    assert nine.seconds_high > two.seconds_high
    seen = estimate_pivot_mesh(arrays, cube(1.5), 2, 10_000)
    assert seen.pivots_low == two.pivots_low + 10_000
    assert seen.pivots_high == two.pivots_high + 40_000
    alone = estimate_pivot_mesh(arrays, cube(1.5), 2, 10_000, alone=True)
    assert alone.pivots_low == alone.pivots_high < two.pivots_low, "no samples and no probes"
    many = estimate_pivot_mesh(arrays, cube(1.5), 2, 10**7)
    assert many.pivots_high <= two.pivots_high + 240_000, "as many as a job looks for"
    assert two.lines()[0].startswith("tetrahedra: ")


def test_too_little_memory_and_a_region_without_gaussians_are_refused() -> None:
    arrays = gaussians_on(sphere(), cube(1.5), 4000, PIVOT_SIGMA)
    expected = estimate_pivot_mesh(arrays, cube(1.5), 9, 9000)
    expected.refuse(0)  # unknown memory refuses nothing
    expected.refuse(expected.memory_low_bytes)
    with pytest.raises(ResourceError, match="Gaussians by pivots needs at least") as refused:
        expected.refuse(expected.memory_low_bytes - 1)
    assert "smaller region" in refused.value.hint
    far = Region.box("far", np.full(3, 50.0), np.full(3, 51.0))
    with pytest.raises(MeshingError, match="'far'"):
        estimate_pivot_mesh(arrays, far, 2, 0)
