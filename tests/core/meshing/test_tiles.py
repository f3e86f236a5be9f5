# SPDX-License-Identifier: GPL-3.0-or-later
"""Tiled meshing: the same tetrahedra as without tiles, and one closed mesh of the same shape."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.field.vacancy import VacancyResult
from gaussian_wrapping_addon.core.mesh.sampling import sample_triangles
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.spacing import Spacing
from gaussian_wrapping_addon.core.meshing.surface_points import (
    CandidateSurface,
    Field,
    SurfacePoints,
    no_caps,
)
from gaussian_wrapping_addon.core.meshing.tiles.plan import (
    CLEARANCE_RADII,
    TilePlan,
    steiner_lattice,
)
from gaussian_wrapping_addon.core.meshing.tiles.tile import (
    GatheredPoints,
    gather,
    local_tetrahedra,
    pieces_in_box,
    tile_faces,
)
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region, Tiling
from gaussian_wrapping_addon.core.settings import MeshingSettings
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
from tests.core.meshing.tiled_meshing import LabelledTiles, mesh_in_tiles
from tests.proofs import first_then_proofs

SIGMA = 0.02
PLATE = rounded_box((1.0, 0.9, 0.02), 0.02)


def mesh_tiles(
    distance: Distance,
    region: Region,
    tiles: int,
    points: int,
    *,
    sigma: float = SIGMA,
    threads: int = 1,
    spacing: str = "uniform",
    around: Distance | None = None,
) -> SurfaceMesh:
    field = ShapeField(distance, sigma)
    arrays = gaussians_on(around or distance, region, 800, sigma)
    settings = MeshingSettings(points=points, spacing=spacing)
    return mesh_in_tiles(
        field, field, arrays, some_cameras(), region, settings, Progress(), tiles=tiles,
        seed=0, threads=threads,
    )  # fmt: skip


def with_tiling(monkeypatch: pytest.MonkeyPatch, tiling: Tiling) -> None:
    """Let the next mesh use this tiling, whatever its plan says."""
    name = "gaussian_wrapping_addon.core.meshing.tiles.plan.split_evenly"
    monkeypatch.setattr(name, lambda *_: tiling)


def test_pieces_cover_the_part_of_the_surface_in_a_box() -> None:
    vertices = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [10, 10, 0], [50, 50, 0]])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 1]])
    low, high = np.array([2.0, 3.0, -1.0]), np.array([4.0, 6.0, 1.0])
    corners, pieces = pieces_in_box(vertices, faces, low, high, 0.5)
    samples = np.random.default_rng(0).uniform(low, high, (300, 3))[:, :2]
    a, b, c = (corners[pieces[:, k]][:, :2] for k in range(3))

    def side(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        d, e = q - p, samples[:, None] - p
        return d[:, 0] * e[..., 1] - d[:, 1] * e[..., 0]

    signs = np.stack([side(a, b), side(b, c), side(c, a)])
    covered = ((signs >= -1e-12).all(0) | (signs <= 1e-12).all(0)).sum(1)
    assert (covered == 1).all()
    lengths = np.linalg.norm(corners[pieces] - corners[pieces[:, [1, 2, 0]]], axis=2)
    whole = ((corners[pieces] >= low) & (corners[pieces] <= high)).all((1, 2))
    assert lengths[~whole].max() <= 0.5
    none, nothing = pieces_in_box(vertices, faces, low + 100, high + 100, 0.5)
    assert len(none) == len(nothing) == 0


def test_too_few_points_and_no_surface_are_told() -> None:
    mesh = mesh_tiles(sphere(), cube(1.3), 2, 40, spacing="adaptive")
    notes = " ".join(n["text"] for n in mesh.provenance["notes"])
    assert "surface points; 40 were requested" in notes
    with pytest.raises(MeshingError, match="holds no surface"):
        mesh_tiles(lambda p: np.full(len(p), 1.0), cube(1.3), 2, 500, around=sphere())


def plan_around(region: Region, tiling: Tiling, radius: float, side: float) -> TilePlan:
    steiner = steiner_lattice(region, side, CLEARANCE_RADII * radius, 0)
    surface = CandidateSurface(np.zeros((3, 3)), np.array([[0, 1, 2]]), 0, 0)
    return TilePlan(
        region, surface, 1.0, Spacing.uniform(radius), tiling, steiner.points, steiner.ball_radius,
        no_caps(), 0, (), 2.0 * radius, 0, 1.0,
    )  # fmt: skip


@cache
def points_on_sheet(count: int = 8000) -> tuple[Region, Tiling, GatheredPoints, TilePlan]:
    """Points on a wavy sheet and a sphere, some exactly on borders of tiles, with their fillers."""
    rng = np.random.default_rng(1)
    radius = 0.004
    ground = rng.uniform(-1, 1, (count, 3))
    ground[:, 2] = 0.1 * np.sin(4 * ground[:, 0]) - 0.4
    ball_radius = rng.normal(size=(3 * count // 8, 3))
    ball_radius *= 0.4 / np.linalg.norm(ball_radius, axis=1)[:, None]
    ball_radius[:, 2] += 0.3
    points = np.concatenate([ground, ball_radius])
    points[::50, 0], points[1::50, 1] = 0.0, 0.0
    region = cube(1.0)
    tiling = Tiling(tuple((tile, axis, 0.0) for axis in range(3) for tile in range(2**axis)))
    plan = plan_around(region, tiling, radius, 0.06)
    normals = np.zeros_like(points)
    normals[:, 2] = 1.0
    cloud = SurfacePoints(
        points, normals, np.zeros(len(points), np.uint8), np.full(len(points), radius), radius,
        (), {},
    )  # fmt: skip
    return region, tiling, gather(plan, [cloud]), plan


def circumradii(points: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return the circumradii, (m,)."""
    base = points[tetrahedra[:, 0]]
    edges = points[tetrahedra[:, 1:]] - base[:, None]  # (m, 3, 3)
    offsets = np.linalg.solve(2.0 * edges, (edges**2).sum(2)[:, :, None])[:, :, 0]
    return np.asarray(np.linalg.norm(offsets, axis=1))


def tetrahedra_of(
    plan: TilePlan, gathered: GatheredPoints, tile: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return numbers of a tile's points, its tetrahedra, and which of their corners are inner."""
    numbers, tetrahedra = local_tetrahedra(plan, gathered, tile, seed, Progress())
    inner = np.append(gathered.inner[numbers], np.zeros(8, np.bool_))
    return numbers, tetrahedra, inner[tetrahedra]


def test_halo_is_a_small_part_and_no_empty_ball_is_larger_than_stated() -> None:
    region, _, gathered, plan = points_on_sheet()
    assert plan.halo < 0.15 * region.diagonal
    whole = replace(plan, tiling=Tiling(()))
    numbers, tetrahedra, inner = tetrahedra_of(whole, gathered, 0, 0)
    shifted = np.concatenate([gathered.shifted[numbers], np.full((8, 3), np.nan)])
    radii = circumradii(shifted, tetrahedra[inner.any(1)])
    assert not np.isnan(radii).any()  # none reaches a far point
    assert radii.max() <= plan.ball_radius


def test_tiles_know_the_same_tetrahedra_as_the_whole() -> None:
    _, tiling, gathered, plan = points_on_sheet()
    numbers, tetrahedra, inner = tetrahedra_of(replace(plan, tiling=Tiling(())), gathered, 0, 0)
    tetrahedra = tetrahedra[inner.all(1)]
    expected = {tuple(row) for row in np.sort(numbers[tetrahedra], 1).tolist()}
    found: list[tuple[int, ...]] = []
    fewest = len(gathered.inner)
    for tile in range(len(tiling)):
        numbers, tetrahedra, inner = tetrahedra_of(plan, gathered, tile, 7)
        fewest = min(fewest, len(numbers))
        tetrahedra = numbers[np.sort(tetrahedra[inner.all(1)], 1)]
        own = tiling.owner(gathered.cloud.points[tetrahedra[:, 0]]) == tile
        found += [tuple(row) for row in tetrahedra[own].tolist()]
    assert fewest < 0.5 * len(gathered.inner)
    assert len(found) == len(set(found))
    assert set(found) == expected


def test_faces_are_closed_whatever_the_labels() -> None:
    _, tiling, gathered, plan = points_on_sheet()

    class Noise:
        def __init__(self, tile: int) -> None:
            self.rng = np.random.default_rng(tile)

        def vacancy(self, points: np.ndarray) -> VacancyResult:
            value = self.rng.uniform(0, 1, len(points)).astype(np.float32)
            return VacancyResult(value, np.zeros(len(points), np.int32))

    parts = [
        tile_faces(Field(Noise(tile), None, 1), plan, gathered, tile, Progress())
        for tile in range(len(tiling))
    ]
    faces = LabelledTiles(Field(None, None, 1), plan, gathered, parts).dense_faces()
    assert len(faces) > 10_000
    assert len(np.unique(np.sort(faces, 1), axis=0)) == len(faces)
    begin, end = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    size = len(gathered.inner)
    forward, back = np.sort(begin * size + end), np.sort(end * size + begin)
    assert (forward == back).all()


@cache
def untiled_volume(name: str, points: int) -> float:
    return float(assert_closed_manifold(mesh_tiles(*SHAPES[name], 1, points)).volume)


SHAPES = {
    "torus": (torus(), cube(1.5)),
    "plate": (PLATE, cube(1.3)),
    "cut": (sphere(), Region.box("cut", np.array([-0.5, -1.2, -1.2]), np.array([0.7, 1.2, 0.3]))),
}


@pytest.mark.parametrize(("name", "euler"), [("torus", 0), ("plate", 2), ("cut", 2)])
@pytest.mark.parametrize("tiles", first_then_proofs([5, 1]))
def test_shape_stays_the_same(name: str, euler: int, tiles: int) -> None:
    mesh = mesh_tiles(*SHAPES[name], tiles, 3000)
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.euler) == (1, euler)
    assert figures.volume == pytest.approx(untiled_volume(name, 3000), rel=3e-3)
    assert mesh.provenance["tiles"] == tiles
    assert mesh.provenance["level_error_p99"] < 0.011
    assert mesh.provenance["vertices_of_fillers"] == 0


def mesh_whole(distance: Distance, region: Region, points: int) -> SurfaceMesh:
    field = ShapeField(distance, SIGMA)
    return mesh_region(
        Field(field, field, 1), gaussians_on(distance, region, 800, SIGMA), some_cameras(), region,
        MeshingSettings(points=points), Progress(), seed=0,
    )  # fmt: skip


def away(mesh: SurfaceMesh, distance: Distance) -> np.ndarray:
    """Distances to the shape of points all over a mesh."""
    points, _ = sample_triangles(mesh.vertices, mesh.faces, 30_000, np.random.default_rng(0))
    return np.abs(distance(points))


@pytest.mark.parametrize(
    ("name", "euler"), first_then_proofs([("torus", 0), ("plate", 2), ("cut", 2)], names=2)
)
def test_adaptive_spacing_is_that_of_the_whole(name: str, euler: int) -> None:
    distance, region = SHAPES[name]
    tiled = mesh_tiles(distance, region, 4, 1200, spacing="adaptive")
    figures = assert_closed_manifold(tiled)
    assert (figures.components, figures.euler) == (1, euler)
    whole = mesh_whole(distance, region, 1200)
    assert len(tiled.vertices) == pytest.approx(len(whole.vertices), rel=0.05)
    assert tiled.provenance["dense_vertices"] > 5 * len(tiled.vertices)
    assert tiled.provenance["dense_vertices"] == pytest.approx(
        whole.provenance["dense_vertices"], rel=0.05
    )
    assert set(whole.provenance) <= set(tiled.provenance)
    assert tiled.provenance["edge_length_scene"] == whole.provenance["edge_length_scene"]
    here, there = away(tiled, distance), away(whole, distance)
    # The plate's rim is rounder than the dense points show: fillers change what connects them.
    room = 1.3 if name == "plate" else 1.1
    assert here.mean() < room * there.mean()
    assert np.quantile(here, 0.99) < 1.1 * room * np.quantile(there, 0.99)


def test_surface_that_lies_in_a_border(monkeypatch: pytest.MonkeyPatch) -> None:
    # The plate's upper side is the plane z = 0.02, its middle the plane z = 0.
    for height in (0.02, 0.0):
        with_tiling(monkeypatch, Tiling(((0, 2, height), (0, 0, 0.0), (1, 1, 0.3))))
        mesh = mesh_tiles(PLATE, cube(1.3), 4, 3000)
        figures = assert_closed_manifold(mesh)
        assert (figures.components, figures.euler) == (1, 2)
        assert figures.volume == pytest.approx(untiled_volume("plate", 3000), rel=5e-3)


def test_empty_tiles_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    # Outside of the region; in empty space; deep inside the solid.
    splits = ((0, 0, 9.0), (0, 2, 0.9), (0, 0, -0.1), (3, 0, 0.1), (3, 1, -0.1), (5, 1, 0.1))
    with_tiling(monkeypatch, Tiling(splits))
    mesh = mesh_tiles(rounded_box((0.7, 0.7, 0.7), 0.2), cube(1.2), 7, 2000)
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.euler) == (1, 2)


def test_same_seed_gives_the_same_mesh_for_any_threads() -> None:
    first = mesh_tiles(*SHAPES["torus"], 3, 1500)
    second = mesh_tiles(*SHAPES["torus"], 3, 1500, threads=2)
    assert (first.vertices == second.vertices).all()
    assert (first.faces == second.faces).all()


def test_scale_invariance() -> None:
    scale, offset = 1e4, np.array([3e4, -2e4, 1e4])
    small = mesh_tiles(*SHAPES["torus"], 3, 1500)
    low, high = cube(1.5).bounds
    shape = torus()
    large = mesh_tiles(
        lambda p: scale * shape((p - offset) / scale),
        Region.box("large", scale * low + offset, scale * high + offset), 3, 1500,
        sigma=scale * SIGMA,
    )  # fmt: skip
    first, second = assert_closed_manifold(small), assert_closed_manifold(large)
    assert second.euler == first.euler
    assert second.volume / scale**3 == pytest.approx(first.volume, rel=2e-3)
