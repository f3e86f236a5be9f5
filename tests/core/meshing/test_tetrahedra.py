# SPDX-License-Identifier: GPL-3.0-or-later
"""Delaunay tetrahedra, marching tetrahedra, minimum cut, clipping to a region."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import Cancelled, MeshingError
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing import delaunay as module
from gaussian_wrapping_addon.core.meshing.checks import (
    MeshStatistics,
    mesh_statistics,
    validate_manifold,
)
from gaussian_wrapping_addon.core.meshing.classification import (
    boundary_faces,
    minimum_cut,
    tetrahedron_neighbours,
)
from gaussian_wrapping_addon.core.meshing.delaunay import bounding_points, delaunay, signed_volumes
from gaussian_wrapping_addon.core.meshing.marching_tetrahedra import (
    CutTetrahedra,
    bisect,
    cut_to_region,
    marching_tetrahedra,
)
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.meshing.meshing_scenes import cube

RNG = np.random.default_rng(0)
AXIS = np.arange(9.0)
DIRECTIONS = RNG.normal(size=(1500, 3))
HARD = {
    "random": RNG.normal(size=(1500, 3)),
    "twice": np.repeat(RNG.normal(size=(500, 3)), 2, axis=0),
    "lattice": np.stack(np.meshgrid(AXIS, AXIS, AXIS), -1).reshape(-1, 3),
    "cospherical": DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None],
    "coplanar": np.c_[RNG.uniform(size=(1000, 2)), np.zeros(1000)],
    "collinear": np.c_[np.arange(300.0), np.zeros((300, 2))],
    "two clusters": np.concatenate(
        [1e-3 * RNG.normal(size=(300, 3)), 1e-3 * RNG.normal(size=(300, 3)) + 1]
    ),
    "utm": RNG.normal(size=(500, 3)) + np.array([5e5, 4e6, 100.0]),
}


def check(points: np.ndarray, tetrahedra: np.ndarray) -> None:
    """Space is filled once: volumes are positive and add up to the hull's, faces match."""
    assert (np.unique(points[np.unique(tetrahedra)], axis=0) == np.unique(points, axis=0)).all()
    extent = float(np.ptp(points, axis=0).max())
    volumes = signed_volumes(points - points.mean(0), tetrahedra)
    assert volumes.min() > -1e-6 * extent**3
    hull = ConvexHull(points - points.mean(0)).volume
    assert volumes.sum() == pytest.approx(hull, rel=1e-5)
    neighbours = tetrahedron_neighbours(tetrahedra)
    for k in range(4):
        there = neighbours[:, k]
        rows = np.flatnonzero(there >= 0)
        assert (neighbours[there[rows]] == rows[:, None]).any(1).all()
    # A hull of triangles: as many faces as Euler's formula allows.
    hull_faces = int((neighbours < 0).sum())
    assert hull_faces % 2 == 0
    assert hull_faces == 2 * len(ConvexHull(points - points.mean(0)).vertices) - 4


@pytest.mark.parametrize("name", HARD)
def test_hard_points_with_far_points(name: str) -> None:
    check(*tetrahedra_of(HARD[name]))


def test_empty_circumspheres() -> None:
    points = HARD["random"][:200]
    tetrahedra = delaunay(points, seed=0, progress=Progress())
    a = points[tetrahedra[:, 0]]
    edges = points[tetrahedra[:, 1:]] - a[:, None]  # (m, 3, 3)
    offset = np.linalg.solve(edges, 0.5 * (edges**2).sum(2)[..., None])[..., 0]
    distance = np.linalg.norm(points[None] - (a + offset)[:, None], axis=2)
    radius = np.linalg.norm(offset, axis=1)
    assert (distance > radius[:, None] - 1e-3).all()


def test_too_few_points_and_infinite_ones_are_refused() -> None:
    for points, words in (
        (np.zeros((0, 3)), "no tetrahedron"),
        (np.zeros((3, 3)), "no tetrahedron"),
        (np.ones((50, 3)), "no tetrahedron"),
        (np.full((5, 3), np.inf), "finite"),
    ):
        with pytest.raises(MeshingError, match=words) as caught:
            delaunay(points, seed=0, progress=Progress())
        assert caught.value.hint


def test_fallback_in_a_helper_process(monkeypatch: pytest.MonkeyPatch) -> None:
    import shull

    def refuse(points: np.ndarray) -> None:
        raise ValueError("points are degenerate")

    monkeypatch.setattr(shull, "Delaunay3d", refuse)
    check(*tetrahedra_of(HARD["lattice"]))


def test_fallback_reports_points_it_cannot_connect() -> None:
    with pytest.raises(Exception, match="could not be triangulated") as caught:
        module.qhull_tetrahedra(np.full((10, 3), np.nan), Progress())
    assert caught.value.hint  # type: ignore[attr-defined]


def test_seed_decides_the_result() -> None:
    points = np.concatenate([HARD["lattice"], bounding_points(HARD["lattice"], 0)])
    first, again, other = (delaunay(points, seed=s, progress=Progress()) for s in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or (first != other).any()


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


def test_every_code_separates_inside_from_outside_in_every_positive_numbering() -> None:
    for order in itertools.permutations(range(4)):
        points = CORNERS[list(order)]
        if np.linalg.det(points[1:] - points[0]) < 0:
            continue
        for code in range(16):
            inside = np.array([bool(code >> k & 1) for k in range(4)])
            edges, faces = marching_tetrahedra(np.arange(4)[None], inside)
            assert faces.shape == ((0, 1, 2, 1, 0)[inside.sum()], 3)
            assert inside[edges[:, 0]].all()
            assert not inside[edges[:, 1]].any()
            middle = points[edges].mean(1)
            for face in faces:
                normal = np.cross(*(middle[face[1:]] - middle[face[0]]))
                side = (points - middle[face[0]]) @ normal
                assert (side[~inside] > 0).all()
                assert (side[inside] < 0).all()


def surface_of(cloud: np.ndarray, empty: Callable, tolerance: float) -> MeshStatistics:
    """Check the surface between the empty and the other points; return its statistics."""
    cloud, tetrahedra = tetrahedra_of(cloud)
    edges, faces = marching_tetrahedra(tetrahedra, ~empty(cloud))
    inside, outside = bisect(cloud[edges[:, 0]], cloud[edges[:, 1]], empty, tolerance, Progress())
    assert not empty(inside).any()
    assert empty(outside).all()
    assert np.linalg.norm(inside - outside, axis=1).max() <= tolerance
    figures = mesh_statistics(SurfaceMesh((inside + outside) / 2, faces.astype(np.int32)))
    assert (figures.closed, figures.euler) == (True, 2)
    return figures


@pytest.mark.parametrize("points", [2000, 16000])
def test_sphere_is_closed_and_its_volume_converges(points: int) -> None:
    cloud = np.random.default_rng(0).uniform(-1.2, 1.2, (points, 3))
    figures = surface_of(cloud, lambda p: np.linalg.norm(p, axis=1) > 0.8, 1e-5)
    assert (figures.nonmanifold_vertices, figures.inconsistent_edges) == (0, 0)
    exact = 4 / 3 * np.pi * 0.8**3
    assert 0 < 1 - figures.volume / exact < 0.9 * points ** (-2 / 3) * 16


def test_sign_change_exactly_on_points_stays_closed() -> None:
    axis = np.linspace(-1, 1, 9)  # points lie exactly on the boundary
    cloud = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    figures = surface_of(cloud, lambda p: np.abs(p).max(1) > 0.5, 1e-3)
    assert figures.volume == pytest.approx(1.0, rel=0.02)


def scipy_cut(links: np.ndarray, capacity: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """The least set inside, from scipy's maximum flow (Dinic): what the source still reaches."""
    count = len(links)
    row, column = np.nonzero(links >= 0)
    strong, weak = np.flatnonzero(pull > 0), np.flatnonzero(pull < 0)
    begins = np.concatenate([row, np.full(len(strong), count), weak])
    ends = np.concatenate([links[row, column], strong, np.full(len(weak), count + 1)])
    values = np.concatenate([capacity[row, column], pull[strong], -pull[weak]])
    graph = csr_matrix((values.astype(np.int32), (begins, ends)), shape=(count + 2, count + 2))
    residual = graph - maximum_flow(graph, count, count + 1).flow
    residual.data[residual.data < 0] = 0
    residual.eliminate_zeros()
    result = np.zeros(count + 2, np.bool_)
    result[breadth_first_order(residual, count, return_predecessors=False)] = True
    return result[:count]


def random_graph(count: int, rng: np.random.Generator, top: int) -> tuple[np.ndarray, np.ndarray]:
    """Four perfect matchings, of which links that occur twice are left out."""
    links = np.full((count, 4), -1, np.int64)
    capacity = np.zeros((count, 4), np.int64)
    for k in range(4):
        order = rng.permutation(count)[: 2 * int(0.45 * count)]
        for i, j in order.reshape(-1, 2):
            if j not in links[i]:
                links[i, k], links[j, k] = j, i
                capacity[i, k] = capacity[j, k] = rng.integers(0, top)
    return links, capacity


@pytest.mark.parametrize("top", [2, 50, 100_000])
@pytest.mark.parametrize("count", [1, 2, 40, 3000])
def test_labels_are_those_of_another_solver(count: int, top: int) -> None:
    rng = np.random.default_rng(count + top)
    links, capacity = random_graph(count, rng, top)
    pull = np.rint(rng.normal(0, 1.5 * top, count)).astype(np.int64)
    pull[rng.random(count) < 0.5] = 0
    label = minimum_cut(links, capacity, pull)
    expected = scipy_cut(links, capacity, pull)
    np.testing.assert_array_equal(label, expected)


def test_order_of_the_nodes_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    links, capacity = random_graph(500, rng, 3)  # many ties
    pull = rng.integers(-4, 5, 500)
    label = minimum_cut(links, capacity, pull)
    order = rng.permutation(500)
    place = np.argsort(order)
    moved = np.where(links >= 0, place[links], -1)[order]
    np.testing.assert_array_equal(minimum_cut(moved, capacity[order], pull[order]), label[order])


def test_a_long_chain_is_cut_at_its_weakest_link() -> None:
    count = 200_000
    chain = np.full((count, 4), -1)
    chain[1:, 0], chain[:-1, 1] = np.arange(count - 1), np.arange(1, count)
    capacity = np.full((count, 4), 9)
    capacity[120_000, 1] = capacity[120_001, 0] = 3
    pull = np.zeros(count, np.int64)
    pull[0], pull[-1] = 7, -8
    np.testing.assert_array_equal(minimum_cut(chain, capacity, pull), np.arange(count) <= 120_000)


def test_large_capacities_do_not_overflow() -> None:
    links = np.array([[1, -1, -1, -1], [0, -1, -1, -1]])
    pull = np.array([2**40, -(2**29)])
    for size, expected in ((2**29 - 1, [True, False]), (2**29 + 1, [True, True])):
        capacity = np.full((2, 4), size)
        assert minimum_cut(links, capacity, pull).tolist() == expected


def test_nothing_and_what_nobody_pulls() -> None:
    none = np.zeros((0, 4), np.int64)
    assert minimum_cut(none, none, np.zeros(0, np.int64)).shape == (0,)
    alone = np.full((3, 4), -1)
    label = minimum_cut(alone, np.zeros((3, 4), np.int64), np.array([1, 0, -1]))
    assert label.tolist() == [True, False, False]  # the fewest inside


def test_a_cut_can_be_stopped() -> None:
    links, capacity = random_graph(50, np.random.default_rng(3), 9)
    with pytest.raises(Cancelled):
        minimum_cut(links, capacity, np.ones(50, int), Progress(is_cancelled=lambda: True))


def tetrahedra_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([points, bounding_points(points, 0)])
    return points, delaunay(points, seed=0, progress=Progress())


def cloud(count: int = 1500) -> np.ndarray:
    return np.random.default_rng(0).uniform(-2, 2, (count, 3))


REGIONS = {
    "box": cube(1.0),
    "turned box": Region.box(
        "r", np.array([-1, -0.5, -0.2]), np.array([1, 0.4, 0.3]),
        Rotation.from_euler("xyz", [0.3, 0.7, 1.1]).as_matrix(),
    ),
    "many faces": Region("ico", np.random.default_rng(1).normal(size=(40, 3))),
    "thin": Region.box("t", np.array([-1, -1, -1e-5]), np.array([1, 1, 1e-5])),
    "corner of four": Region("p", np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])),
}  # fmt: skip


def assert_fills(cut: CutTetrahedra, region: Region) -> None:
    volumes = signed_volumes(cut.points, cut.tetrahedra)
    assert volumes.min() > -1e-12 * region.volume
    assert volumes.sum() == pytest.approx(region.volume, rel=1e-9)
    used = np.unique(cut.tetrahedra)
    assert region.distance(cut.points[used]).max() <= 1e-12 * np.abs(cut.points[used]).max()
    # No face of more than two tetrahedra, and the hull is the region's closed boundary.
    everything = np.ones(len(cut.tetrahedra), np.bool_)
    neighbours = tetrahedron_neighbours(cut.tetrahedra)
    hull = boundary_faces(cut.tetrahedra, neighbours, everything)
    area = mesh_statistics(SurfaceMesh(cut.points, hull.astype(np.int32))).area
    assert area == pytest.approx(region.area, rel=1e-9)
    check = validate_manifold(cut.points, hull)
    assert check.open_edges == check.nonmanifold_edges == check.inconsistent_edges == 0
    assert check.nonmanifold_vertices == 0
    assert check.parts[0].euler == 2


@pytest.mark.parametrize("name", REGIONS)
@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1e-3, 0.0), (1e4, 4e6)])
def test_the_parts_fill_the_region_exactly(name: str, scale: float, shift: float) -> None:
    region = Region(name, REGIONS[name].vertices * scale + shift)
    assert_fills(cut_to_region(*tetrahedra_of(cloud() * scale + shift), region), region)


def test_points_on_the_planes_edges_and_corners() -> None:
    axis = np.linspace(-2, 2, 9)  # the region's planes go through points of the lattice
    lattice = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    assert_fills(cut_to_region(*tetrahedra_of(lattice), cube(1.0)), cube(1.0))


def test_every_numbering_of_two_tetrahedra_agrees_on_their_common_face() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1], [0.3, 0.3, -1.0]])
    pair = np.array([[0, 1, 2, 3], [0, 2, 1, 4]])
    for order in itertools.permutations(range(5)):
        place = np.argsort(order)
        for axis in range(3):
            low = np.full(3, -9.0)
            low[axis] = 0.15
            region = Region.box("half", low, np.full(3, 9.0))
            cut = cut_to_region(points[list(order)], place[pair], region)
            hull = boundary_faces(
                cut.tetrahedra, tetrahedron_neighbours(cut.tetrahedra),
                np.ones(len(cut.tetrahedra), np.bool_),
            )  # fmt: skip
            check = validate_manifold(cut.points, hull)
            assert check.open_edges == check.nonmanifold_edges == check.inconsistent_edges == 0
            assert check.euler == 2
            assert (signed_volumes(cut.points, cut.tetrahedra) > 0).all()


def test_nothing_is_left_of_tetrahedra_elsewhere_and_all_of_those_within() -> None:
    points, tetrahedra = tetrahedra_of(cloud(200))
    far = Region.box("far", np.full(3, 1e3), np.full(3, 2e3))
    assert len(cut_to_region(points, tetrahedra, far).tetrahedra) == 0
    whole = cut_to_region(points, tetrahedra, cube(1e3))
    assert np.array_equal(whole.tetrahedra, tetrahedra)
    assert np.array_equal(whole.points, points)
