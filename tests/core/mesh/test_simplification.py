# SPDX-License-Identifier: GPL-3.0-or-later
"""Decimation: its target, what it keeps, quadrics, the heap, edges flipped."""

from __future__ import annotations

import functools
from collections.abc import Callable

import igl
import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled, MeshingError
from gaussian_wrapping_addon.core.mesh import simplification
from gaussian_wrapping_addon.core.mesh.components import compacted
from gaussian_wrapping_addon.core.mesh.edge_collapse import (
    COUNTERS,
    DONE,
    FULL,
    HEAP_SIZE,
    MAX_RING,
    PAUSED,
    WEIGHT,
    error_of_both,
    error_of_one,
    link_allows,
    mark_ring,
    pop_first,
    sift_up_last,
)
from gaussian_wrapping_addon.core.mesh.sampling import distances_to_mesh, sample_triangles
from gaussian_wrapping_addon.core.mesh.simplification import (
    LIMITS,
    DecimationResult,
    Heap,
    Simplification,
    decimate,
    flip_edges,
    select_vertices,
)
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh, normals_and_areas
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.field.field_scenes import unit_sphere
from tests.core.mesh.test_vertex_selection import hull
from tests.core.mesh.test_vertex_selection import ring as ring_of_edge_flips
from tests.core.meshing.closed_shapes import (
    Mesh,
    ball,
    joined,
    lattice,
    noisy,
    ring,
    sharpest_bend_cos,
    slab,
    wire,
)
from tests.core.meshing.meshing_scenes import assert_closed_manifold, torus

SHAPES: dict[str, Callable[[], Mesh]] = {
    "ball": ball,
    "torus": ring,
    "plate": lambda: slab((1, 1, 0.005), 0.1),
    "wire": wire,
    "lattice": lattice,
    "uneven": lambda: noisy(ring(), 0.01),
    "several": lambda: joined(ball(3), (ring()[0] + 5, ring()[1]), (wire()[0] - 5, wire()[1])),
}


def decimated(mesh: Mesh, target: int, **options: object) -> DecimationResult:
    return decimate(*mesh, target, Progress(), **options)


@pytest.mark.parametrize("share", [0.5, 0.1])
@pytest.mark.parametrize("name", SHAPES)
def test_target_is_met_and_the_mesh_stays_closed_with_its_genus(name: str, share: float) -> None:
    mesh = SHAPES[name]()
    before = validate_manifold(*mesh)
    target = round(share * len(mesh[1]))
    result = decimated(mesh, target)
    after = validate_manifold(result.vertices, result.faces)
    assert result.reached
    assert target - 2 < len(result.faces) <= target
    assert after.good, after.defects()
    assert sorted(p.genus or 0 for p in after.parts) == sorted(p.genus or 0 for p in before.parts)
    assert after.volume == pytest.approx(before.volume, rel=0.1)
    worst = min(LIMITS.fold_cos, sharpest_bend_cos(mesh))
    assert sharpest_bend_cos((result.vertices, result.faces)) >= worst - 1e-9
    size = np.ptp(mesh[0], axis=0).max()
    made = result.vertices, result.faces
    for one, other in ((mesh, made), (made, mesh)):
        assert distances_to_mesh(one[0], *other)[0].max() < 0.02 * size
    again = decimated(mesh, target)
    np.testing.assert_array_equal(again.faces, result.faces)
    np.testing.assert_array_equal(again.vertices, result.vertices)


def test_why_not_by_a_library() -> None:
    """Quadrics of libigl close the holes of a lattice in part: faces meet that must not.

    Where this fails, libigl has learnt it, and may take the place of our own collapse.
    """
    vertices, faces = lattice()
    target = len(faces) // 10
    theirs = igl.qslim(
        np.asfortranarray(vertices), np.asfortranarray(faces.astype(np.int64)), target
    )
    assert not validate_manifold(theirs[0], theirs[1]).good
    result = decimated((vertices, faces), target)
    assert validate_manifold(result.vertices, result.faces).good


def test_flat_faces_cost_nothing() -> None:
    mesh = slab((1.0, 0.7, 0.3), 0.06)
    result = decimated(mesh, 12)
    assert len(result.faces) == 12
    corners = 2 * np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T - 1
    error = np.abs(result.vertices[:, None] - corners * [1.0, 0.7, 0.3]).max(2).min(1)
    assert error.max() < 1e-3  # the even spread of points is weighed against planes, very lightly


def test_targets_out_of_reach_end_at_what_the_shape_allows() -> None:
    mesh = ball(2)
    assert len(decimated(mesh, 4).faces) <= 8
    two = joined(ball(2), (ball(1)[0] + 4, ball(1)[1]))
    for given, genera in ((two, [0, 0]), (ring(), [1])):
        result = decimated(given, 4)
        check = validate_manifold(result.vertices, result.faces)
        assert (check.good, result.reached) == (True, False)
        assert [part.genus for part in check.parts] == genera
    for target in (len(mesh[1]), 10**6):
        result = decimated(mesh, target)
        np.testing.assert_array_equal(result.faces, mesh[1])
        assert result.reached


@pytest.mark.parametrize(("scale", "shift"), [(1e-3, 0.0), (1e4, 0.0), (1.0, 4e6), (1e4, 4e6)])
def test_neither_scale_nor_place_changes_the_result(scale: float, shift: float) -> None:
    vertices, faces = noisy(ring(60, 20), 0.01)
    # Digits that a far origin would take are taken before, so that both start from one mesh.
    step = 2.0**-20
    vertices = np.round(vertices / step) * step
    power = 2.0 ** round(np.log2(scale))
    here = decimated((vertices, faces), 500)
    there = decimated((vertices * power + shift, faces), 500)
    size = np.ptp(vertices, axis=0).max()
    error = distances_to_mesh((there.vertices - shift) / power, here.vertices, here.faces)[0]
    assert len(there.faces) == len(here.faces)
    assert error.max() < 2e-3 * size
    assert validate_manifold(there.vertices, there.faces).good


def test_vertices_on_the_region_stay_on_it_and_none_leaves_it() -> None:
    mesh = noisy(slab((1, 1, 1), 0.1), 0.0)
    # Three faces of the cube are caps; the surface is uneven elsewhere, up to the region.
    vertices, faces = mesh
    region = Region.box("cut", [-1.2, -1.2, -1.2], [1.0, 1.0, 1.0])
    rng = np.random.default_rng(0)
    free = (vertices < 1.0 - 1e-9).all(1)
    vertices = vertices.copy()
    vertices[free] += 0.02 * rng.normal(size=(free.sum(), 3))
    vertices[free] = np.minimum(vertices[free], 1.0 - 1e-3)
    result = decimated((vertices, faces), 300, region=region)
    check = validate_manifold(result.vertices, result.faces)
    assert check.good, check.defects()
    assert len(result.faces) <= 300
    assert region.contains(result.vertices, 1e-12).all()
    caps = np.abs(result.vertices[result.faces] - 1.0).max(1) < 1e-12  # (f, 3) whole faces on x,y,z
    area = normals_and_areas(result.vertices, result.faces)[1]
    assert np.array([area[caps[:, k]].sum() for k in range(3)]) == pytest.approx(4.0, rel=0.03)
    assert (np.abs(result.vertices - 1.0).max(1) < 1e-12).sum() == 1, "the corner of three caps"


def test_an_open_boundary_stays_as_it_is() -> None:
    vertices, faces = ball(4)
    faces = faces[(vertices[faces][:, :, 2] <= 0.0).all(1)]
    used, index = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], index.reshape(-1, 3)
    before = validate_manifold(vertices, faces)
    result = decimated((vertices, faces), len(faces) // 4)
    after = validate_manifold(result.vertices, result.faces)
    assert after.open_edges == before.open_edges > 0
    assert (after.euler, after.nonmanifold_edges, after.nonmanifold_vertices) == (1, 0, 0)
    rim = vertices[np.abs(vertices[:, 2]) < 1e-9]
    assert (np.abs(result.vertices[:, None] - rim).max(2).min(0) == 0.0).all()


def test_bad_input_is_refused() -> None:
    vertices, faces = ball(2)
    for mesh, target, words in (
        ((vertices, faces), 3, "3 faces"),
        ((vertices, np.concatenate([faces, faces[:1]])), 20, "manifold"),
        ((np.full_like(vertices, np.nan), faces), 20, "finite size"),
        ((np.zeros_like(vertices), faces), 20, "finite size"),
    ):
        with pytest.raises(MeshingError, match=words):
            decimated(mesh, target)


def test_it_can_be_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simplification, "EDGES_PER_CALL", 50)
    asked = []

    def is_cancelled() -> bool:
        asked.append(1)
        return len(asked) > 3

    with pytest.raises(Cancelled):
        decimate(*ball(), 100, Progress(is_cancelled=is_cancelled))


def bipyramid(around: int) -> tuple[np.ndarray, np.ndarray]:
    """A ring of vertices between two tips, the last two."""
    angle = 2 * np.pi * np.arange(around) / around
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(around)], 1)
    j, k = np.arange(around), (np.arange(around) + 1) % around
    low, high = np.full(around, around), np.full(around, around + 1)
    faces = np.concatenate([np.stack([low, k, j], 1), np.stack([high, j, k], 1)])
    return np.concatenate([rim, [[0, 0, -1.0], [0, 0, 1.0]]]), faces


def started(points: np.ndarray, faces: np.ndarray, scale: float = 0.5) -> Simplification:
    return Simplification(points, np.array(faces, np.int64), scale, 0.0)


def allowed(run: Simplification, u: int, v: int, max_ring: int = MAX_RING) -> bool:
    around, mark = mark_ring(u, run.mesh, run.counts, np.empty(0, np.int64))
    return bool(link_allows(u, v, around, mark, max_ring, run.mesh, run.counts))


def test_a_quadric_is_the_sum_of_squared_distances_by_area() -> None:
    points, faces = bipyramid(6)
    run = started(points, faces)
    quadrics = run.mesh[4]
    corners = points[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    place = np.array([0.3, -0.2, 0.4])
    distance = ((place - corners[:, 0]) * cross).sum(1) / (2 * area)
    for vertex in range(len(points)):
        own = (faces == vertex).any(1)
        expected = (area * distance**2)[own].sum()
        assert error_of_one(quadrics, vertex, *place) == pytest.approx(expected, rel=1e-12)
        assert quadrics[vertex, WEIGHT] == pytest.approx(area[own].sum())
    both = error_of_one(quadrics, 0, *place) + error_of_one(quadrics, 3, *place)
    assert error_of_both(quadrics, 0, 3, *place) == pytest.approx(both, rel=1e-12)


def test_a_full_heap_grows_and_keeps_its_entries() -> None:
    run = started(*bipyramid(5))
    heap = run.empty_heap(1, 2)
    size = len(heap[0])
    heap[0][:], heap[1][:], heap[2][:] = np.arange(size), 5, 7
    lengths, states = [], iter((PAUSED, FULL, DONE))

    def collapse(given: Heap) -> int:
        lengths.append([len(column) for column in given])
        np.testing.assert_array_equal(given[0][:size], np.arange(size))
        assert (given[1][:size] == 5).all()
        assert (given[2][:size] == 7).all()
        return next(states)

    run.run(heap, collapse)
    assert lengths == [[size] * 3, [size] * 3, [2 * size] * 3]


@pytest.mark.parametrize(("around", "goes"), [(MAX_RING, True), (MAX_RING + 1, False)])
def test_nothing_merges_into_a_fan_that_is_too_wide(around: int, goes: bool) -> None:
    """A vertex with three faces would leave the tip with one face fewer than it had."""
    points, faces = bipyramid(around - 2)
    tip, first = len(points) - 1, len(points)
    for _ in range(2):  # divided faces bring the tip to the number of faces asked for
        new = len(points)
        row = np.flatnonzero((faces == tip).any(1) & (faces < first).all(1))[0]
        a, b, c = faces[row]
        points = np.concatenate([points, [points[faces[row]].mean(0)]])
        faces = np.concatenate([np.delete(faces, row, 0), [[a, b, new], [b, c, new], [c, a, new]]])
    assert (faces == tip).sum() == around
    limit = MAX_RING - 1  # for a vertex with three faces, as half-edge collapses ask
    assert allowed(started(points, faces), first, tip, limit) is goes


def test_selection_of_a_mesh_in_another_memory_order_is_the_same() -> None:
    points, faces = bipyramid(40)
    chosen = select_vertices(points, faces, 12, 10.0)
    turned = select_vertices(points, np.asfortranarray(faces), 12, 10.0)
    assert 0 < len(chosen) < len(faces)
    np.testing.assert_array_equal(chosen, turned)


def test_the_heap_gives_the_least_whole_entry_while_others_come() -> None:
    rng = np.random.default_rng(1)
    heap = (np.zeros(400), *(np.zeros(400, np.int64) for _ in range(2)))
    counts = np.zeros(COUNTERS, np.int64)
    kept: list[tuple[float, ...]] = []
    for number in range(300):
        entry = (int(rng.integers(0, 20)) / 7.0, number, 7 * number)  # many equal costs
        for column, value in zip(heap, entry, strict=True):
            column[counts[HEAP_SIZE]] = value
        sift_up_last(heap, counts)
        kept.append(entry)
        if number % 3 == 2:
            assert tuple(column[0].item() for column in heap) == min(kept)
            pop_first(heap, counts)
            kept.remove(min(kept))
    assert counts[HEAP_SIZE] == len(kept) == 200


def face_set(faces: np.ndarray) -> set[tuple[int, ...]]:
    """Faces with their smallest corner first."""
    return {tuple(np.roll(face, -int(face.argmin())).tolist()) for face in faces}


def flipped(faces: np.ndarray, count: int) -> np.ndarray:
    """The same mesh with so many edges turned, none of which share a corner."""
    result, used = faces.copy(), set()
    for f in range(len(faces)):
        a, b, c = faces[f].tolist()
        (g,) = [i for i in np.flatnonzero((faces == a).any(1) & (faces == b).any(1)) if i != f]
        (d,) = set(faces[g].tolist()) - {a, b}
        if count > 0 and not used & {a, b, c, d}:
            result[f], result[g] = (a, d, c), (d, b, c)
            used |= {a, b, c, d}
            count -= 1
    assert count == 0
    return result


@pytest.mark.parametrize(("scale", "offset"), [(1e-3, 0.0), (1e4, 0.0), (1.0, 1e4)])
def test_turned_edges_turn_back(scale: float, offset: float) -> None:
    points = unit_sphere(150)
    faces = hull(points)
    where = scale * points + offset
    turned = flipped(faces, 20)
    assert len(face_set(turned) & face_set(faces)) == len(faces) - 40
    again = flip_edges(where, turned, where, faces, 10.0 * scale)
    assert face_set(again) == face_set(faces)


@functools.cache
def coarse_torus() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points and faces of a fine torus, vertices and faces of one of 400 vertices."""
    points, faces = ring_of_edge_flips(120, 60)
    vertices, coarse, _ = compacted(points, select_vertices(points, faces, 400, 10.0))
    return points, faces, vertices, coarse


def assert_torus(vertices: np.ndarray, faces: np.ndarray) -> None:
    figures = assert_closed_manifold(SurfaceMesh(vertices, faces.astype(np.int32), {}))
    assert (figures.vertices, figures.genus, figures.components) == (400, 1, 1)


def test_error_falls_and_the_shape_stays_closed_without_longer_edges_than_allowed() -> None:
    points, faces, vertices, coarse = coarse_torus()
    errors = []
    for each in (coarse, flip_edges(vertices, coarse, points, faces, 10.0)):
        assert_torus(vertices, each)
        where, _ = sample_triangles(vertices, each, 40_000, np.random.default_rng(0))
        errors.append(np.abs(torus()(where)).mean())
    assert errors[1] < 0.95 * errors[0]
    before, after = (
        {tuple(edge) for edge in np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1).tolist()}
        for f in (coarse, flip_edges(vertices, coarse, points, faces, 0.25))
    )
    made = np.array(sorted(after - before))
    assert len(made)
    assert np.linalg.norm(vertices[made[:, 0]] - vertices[made[:, 1]], axis=1).max() <= 0.25


def test_what_fits_already_and_what_is_flat_stays() -> None:
    points = unit_sphere(200)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    for where in (points, corners):
        faces = hull(where)
        np.testing.assert_array_equal(flip_edges(where, faces, where, faces, 10.0), faces)
    none = np.zeros((0, 3), np.int64)
    assert flip_edges(np.zeros((0, 3)), none, points, hull(points), 1.0).shape == (0, 3)


def test_a_part_is_flipped_like_the_whole_and_nothing_else() -> None:
    points, faces, vertices, coarse = coarse_torus()
    everything = np.ones(len(coarse), np.bool_)
    whole = flip_edges(vertices, coarse, points, faces, 10.0)
    again = flip_edges(vertices, coarse, points, faces, 10.0, everything)
    np.testing.assert_array_equal(again, whole)

    movable = vertices[coarse].mean(1)[:, 0] > 0
    at = np.zeros(len(vertices), np.bool_)
    at[coarse[movable]] = True
    rows = np.flatnonzero(at[coarse].any(1))
    local_vertices, local, source = compacted(vertices, coarse[rows])
    assert len(rows) < len(coarse)
    part = coarse.copy()
    part[rows] = source[flip_edges(local_vertices, local, points, faces, 10.0, movable[rows])]
    np.testing.assert_array_equal(part[~movable], coarse[~movable])
    assert (part != coarse).any(1).sum() > 10
    assert_torus(vertices, part)
