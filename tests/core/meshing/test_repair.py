# SPDX-License-Identifier: GPL-3.0-or-later
"""Repair of faces, floaters and statistics; the manifold check against trimesh."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.mesh.components import without_floaters
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import (
    MAX_LISTED_PARTS,
    MIN_HEIGHT_SHARE,
    MeshStatistics,
    mesh_statistics,
    validate_manifold,
)
from gaussian_wrapping_addon.core.meshing.classification import (
    boundary_faces,
    tetrahedron_neighbours,
)
from gaussian_wrapping_addon.core.meshing.delaunay import bounding_points, delaunay
from gaussian_wrapping_addon.core.meshing.repair import (
    RepairResult,
    narrow_faces,
    remove_degenerate,
    split_nonmanifold,
)
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.meshing.closed_shapes import Mesh, ball, joined, lattice, noisy, ring, slab, wire
from tests.core.meshing.meshing_scenes import assert_closed_manifold


def cubes(*cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the boundary of a union of unit cells, with shared lattice vertices."""
    solid = set(cells)
    corners: dict[tuple[int, ...], int] = {}
    faces = []
    for cell in cells:
        for axis in range(3):
            for sign in (0, 1):
                step = [0, 0, 0]
                step[axis] = 2 * sign - 1
                if tuple(np.add(cell, step)) in solid:
                    continue
                u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
                base = np.array(cell) + sign * np.eye(3, dtype=int)[axis]
                quad = [base, base + u, base + u + v, base + v]
                if sign == 0:
                    quad.reverse()
                index = [corners.setdefault(tuple(q.tolist()), len(corners)) for q in quad]
                faces += [[index[0], index[1], index[2]], [index[0], index[2], index[3]]]
    return np.array(list(corners), np.float64), np.array(faces)


def as_mesh(vertices: np.ndarray, faces: np.ndarray) -> SurfaceMesh:
    return SurfaceMesh(vertices, faces.astype(np.int32))


def repaired(vertices: np.ndarray, faces: np.ndarray) -> tuple[RepairResult, MeshStatistics]:
    result = split_nonmanifold(vertices, faces)
    return result, assert_closed_manifold(as_mesh(result.vertices, result.faces))


def test_one_cube_stays_as_it_is() -> None:
    vertices, faces = cubes((0, 0, 0))
    result, figures = repaired(vertices, faces)
    assert (figures.euler, figures.genus, figures.volume) == (2, 0, pytest.approx(1.0))
    assert (result.split_vertices, result.split_edges) == (0, 0)
    np.testing.assert_array_equal(result.vertices[result.faces], vertices[faces])


@pytest.mark.parametrize(("other", "shared"), [((1, 1, 0), 2), ((1, 1, 1), 1)])
def test_two_cubes_that_share_an_edge_or_a_vertex(other: tuple, shared: int) -> None:
    vertices, faces = cubes((0, 0, 0), other)
    before = mesh_statistics(as_mesh(vertices, faces))
    assert before.nonmanifold_edges + before.nonmanifold_vertices == 1
    assert (before.closed, before.genus) == (shared == 1, None)
    result, figures = repaired(vertices, faces)
    assert (figures.components, figures.genus) == (2, 0)
    assert (result.split_vertices, result.split_edges) == (shared, 0)
    assert figures.volume == pytest.approx(2.0, rel=0.05)
    # Merging equal points must not join the parts again.
    assert len(np.unique(np.round(result.vertices, 6), axis=0)) == len(result.vertices) == 16


def test_edge_whose_both_ends_are_joined_elsewhere() -> None:
    # Two diagonal cells, joined above and below: around the edge both wedges belong together.
    cells = [(0, 0, 1), (1, 1, 1)]
    cells += [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 2)]
    vertices, faces = cubes(*cells)
    assert mesh_statistics(as_mesh(vertices, faces)).nonmanifold_edges == 1
    result, figures = repaired(vertices, faces)
    assert result.split_edges == 2
    assert figures.components == 1
    assert figures.volume == pytest.approx(len(cells), rel=0.02)
    assert (result.origin == -1).sum() == 2


def random_surface(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Points, the boundary of half of their tetrahedra, and its volume."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points = np.concatenate([points, bounding_points(points, seed)])
    tetrahedra = delaunay(points, seed=seed, progress=Progress())
    inside = (rng.random(len(tetrahedra)) < 0.5) & (tetrahedra < count).all(1)
    faces = boundary_faces(tetrahedra, tetrahedron_neighbours(tetrahedra), inside)
    corners = points[tetrahedra[inside]]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6
    return points, faces, volume


@pytest.mark.parametrize("seed", range(4))
def test_random_labels_of_tetrahedra_become_manifold(seed: int) -> None:
    points, faces, volume = random_surface(120, seed)
    assert mesh_statistics(as_mesh(points, faces)).nonmanifold_edges > 20
    assert repaired(points, faces)[1].volume == pytest.approx(volume, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_parts_repaired_one_after_another_are_the_whole_repaired(seed: int) -> None:
    points, faces, _ = random_surface(150, seed)
    whole, expected = repaired(points, faces)
    # Vertices left of a plane that have no faces across it.
    left = points[:, 0] < 0
    across = np.zeros(len(points), np.bool_)
    across[faces[(~left[faces]).any(1)]] = True
    near = faces[left[faces].any(1)]
    first = split_nonmanifold(points, near, ~left | across)
    assert first.split_vertices > 10
    # The same faces, then repaired everywhere, with the parts that touch parted alike.
    far = faces[~left[faces].any(1)]
    number = np.full(len(points), -1)
    held = np.flatnonzero((first.origin >= 0) & (~left | across)[np.maximum(first.origin, 0)])
    number[first.origin[held]] = held
    missing = np.setdiff1d(far, first.origin[held])
    number[missing] = len(first.vertices) + np.arange(len(missing))
    vertices = np.concatenate([first.vertices, points[missing]])
    second, figures = repaired(vertices, np.concatenate([first.faces, number[far]]))
    assert figures.components == expected.components
    assert first.split_vertices + second.split_vertices == whole.split_vertices
    assert figures.volume == pytest.approx(expected.volume, rel=0.02)


def test_open_faces_are_refused() -> None:
    vertices, faces = cubes((0, 0, 0))
    elsewhere = np.zeros(len(vertices), np.bool_)
    elsewhere[faces[0]] = True
    part = split_nonmanifold(vertices, faces[1:], elsewhere)
    np.testing.assert_array_equal(part.faces, faces[1:])
    elsewhere[faces[0][0]] = False
    for given in ((), (elsewhere,)):
        with pytest.raises(MeshingError, match="not closed"):
            split_nonmanifold(vertices, faces[1:], *given)


def test_flat_face_and_needle_are_removed() -> None:
    vertices, faces = cubes((0, 0, 0))
    # A vertex on the middle of an edge of face 0, and one beside a corner of face 2.
    a, b, c = faces[0]
    vertices = np.concatenate([vertices, [(vertices[a] + vertices[b]) / 2]])
    middle = len(vertices) - 1
    flat = np.concatenate([faces[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]])
    assert_after = mesh_statistics(as_mesh(vertices, flat))
    assert (assert_after.closed, assert_after.degenerate_faces) == (True, 1)
    fixed, left = remove_degenerate(vertices, flat, 1e-6)
    assert left == 0
    figures = assert_closed_manifold(as_mesh(vertices, fixed))
    assert figures.volume == pytest.approx(1.0, rel=1e-12)
    assert figures.euler == 2

    d = faces[2][0]
    towards = vertices[faces[2]].mean(0) - vertices[d]
    vertices = np.concatenate([vertices, [vertices[d] + 1e-9 * towards]])
    near = len(vertices) - 1
    d, e, f = faces[2]
    others = np.delete(fixed, np.flatnonzero((np.sort(fixed, 1) == np.sort(faces[2])).all(1)), 0)
    needle = np.concatenate([others, [[d, e, near], [e, f, near], [f, d, near]]])
    assert len(narrow_faces(vertices, needle, 1e-6)) == 2
    fixed, left = remove_degenerate(vertices, needle, 1e-6)
    assert left == 0
    assert near not in fixed
    assert mesh_statistics(as_mesh(vertices, fixed)).volume == pytest.approx(1.0)


def test_a_face_along_the_region_s_edge_is_flipped_away() -> None:
    """Three points of the edge in one face: its long side is not an edge that has to stay."""
    vertices, faces = cubes((0, 0, 0))
    region = Region.box("r", np.zeros(3), np.ones(3))
    begin, end, tip = faces[0]
    assert np.linalg.norm(vertices[begin] - vertices[end]) == 1.0, "an edge of the cube"
    middle = len(vertices)
    vertices = np.concatenate([vertices, vertices[[begin, end]].mean(0)[None]])
    divided = [[middle, end, tip], [begin, middle, tip], [begin, end, middle]]
    flat = np.concatenate([faces[1:], divided])
    assert mesh_statistics(as_mesh(vertices, flat)).closed
    kept, left = remove_degenerate(vertices, flat, 1e-3, region)
    assert left == 0
    assert_closed_manifold(as_mesh(vertices, kept))
    assert middle in kept
    assert mesh_statistics(as_mesh(vertices, kept)).volume == pytest.approx(1.0, rel=1e-12)


def hollow_cube() -> list[tuple[int, int, int]]:
    cells = [(x, y, z) for x in range(3) for y in range(3) for z in range(3)]
    cells.remove((1, 1, 1))
    return cells


def test_floaters_and_cavities_are_counted_and_the_largest_parts_keep_their_cavities() -> None:
    vertices, faces = cubes(*hollow_cube(), (5, 0, 0), (7, 0, 0), (8, 0, 0))
    figures = assert_closed_manifold(as_mesh(vertices, faces))
    assert (figures.components, figures.volume) == (4, pytest.approx(26 + 3))
    result = without_floaters(vertices, faces, 0.15)  # areas 54, 6 (cavity), 6, 10
    assert (result.kept, result.removed_solids, result.removed_cavities) == (2, 1, 1)
    assert result.removed_area_share == pytest.approx(12 / 76)
    one = without_floaters(vertices, faces, 0.0, 1)
    assert (one.kept, one.removed_solids, one.removed_cavities) == (2, 2, 0)
    assert mesh_statistics(as_mesh(vertices, one.faces)).volume == pytest.approx(26)
    assert one.removed_area_share == pytest.approx(16 / 76)
    two = without_floaters(vertices, faces, 0.0, 2)
    assert mesh_statistics(as_mesh(vertices, two.faces)).volume == pytest.approx(28)
    for most in ((), (9,)):
        assert len(without_floaters(vertices, faces, 0.0, *most).faces) == len(faces)


def test_a_cavity_goes_with_its_solid() -> None:
    """Its box lies inside that of a larger solid, a ring around both."""
    around = range(-3, 6)
    ring = [(x, y, 1) for x in around for y in around if max(abs(x - 1), abs(y - 1)) == 4]
    vertices, faces = cubes(*hollow_cube(), *ring)
    result = without_floaters(vertices, faces, 0.0, 1)
    assert (result.kept, result.removed_solids, result.removed_cavities) == (1, 1, 1)
    assert mesh_statistics(as_mesh(vertices, result.faces)).volume == pytest.approx(len(ring))


def test_statistics_of_broken_meshes() -> None:
    empty = mesh_statistics(as_mesh(np.zeros((0, 3)), np.zeros((0, 3))))
    assert (empty.faces, empty.components, empty.closed, empty.genus) == (0, 0, False, None)
    vertices, faces = cubes((0, 0, 0))
    holed = mesh_statistics(as_mesh(vertices, faces[1:]))
    assert (holed.boundary_edges, holed.closed, holed.genus) == (3, False, None)
    turned = faces.copy()
    turned[0] = turned[0][::-1]
    twisted = mesh_statistics(as_mesh(vertices, turned))
    assert (twisted.inconsistent_edges, twisted.closed) == (3, False)
    assert mesh_statistics(as_mesh(vertices, faces)).to_json()["genus"] == 0


def test_a_piece_of_wire_is_no_floater_and_a_long_sliver_is_one() -> None:
    block = [(x, y, z) for x in range(10) for y in range(10) for z in range(10)]
    wire = [(x, 20, 0) for x in range(4)]
    vertices, faces = cubes(*block, *wire, (30, 0, 0))
    result = without_floaters(vertices, faces, 0.05)  # areas 600, 18, 6; lengths 17.3, 4.2, 1.7
    assert (result.kept, result.removed_solids) == (2, 1)
    assert result.removed_area_share == pytest.approx(6 / 624)
    # Four long faces are not a wire, however long they are.
    body = cubes((0, 0, 0), (1, 0, 0))
    corners = np.array([[20.0, 0, 0], [28, 0, 0], [24, 0.002, 0], [24, 0, 0.002]])
    both = joined(body, (corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])))
    assert mesh_statistics(as_mesh(*both)).closed
    result = without_floaters(*both, 0.01)
    assert (len(result.faces), result.removed_solids) == (len(body[1]), 1)


SHAPES: dict[str, tuple[Callable[[], Mesh], tuple[int, ...]]] = {
    "ball": (lambda: ball(3), (0,)),
    "torus": (ring, (1,)),
    "plate": (lambda: slab((1, 1, 0.005), 0.2), (0,)),
    "wire": (wire, (0,)),
    "lattice": (lattice, (9,)),
    "ball and torus": (lambda: joined(ball(2), (ring()[0] + 5, ring()[1])), (1, 0)),
    "noise": (lambda: noisy(ball(3), 0.3), (0,)),
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1e-3, 0.0), (1e4, 4e6)])
def test_good_meshes_pass_and_trimesh_agrees(name: str, scale: float, shift: float) -> None:
    make, genus = SHAPES[name]
    vertices, faces = make()
    vertices = vertices * scale + shift
    check = validate_manifold(vertices, faces)
    assert (check.good, check.defects()) == (True, [])
    assert tuple(part.genus for part in check.parts) == genus
    other = trimesh.Trimesh(vertices - shift, faces, process=False)
    assert other.is_watertight
    assert other.is_winding_consistent
    assert check.euler == other.euler_number == sum(part.euler for part in check.parts)
    assert check.volume == pytest.approx(other.volume, rel=1e-6)
    assert len(check.parts) == other.body_count
    figures = mesh_statistics(SurfaceMesh(vertices, faces.astype(np.int32)))
    assert (figures.euler, figures.genus) == (check.euler, sum(genus))


def _with(vertices: np.ndarray, faces: np.ndarray, *, add: list | None = None) -> Mesh:
    more = np.array(add, np.int64).reshape(-1, 3) if add else np.zeros((0, 3), np.int64)
    return vertices, np.concatenate([faces, more])


def _turned() -> Mesh:
    vertices, faces = cubes((0, 0, 0))
    faces[0] = faces[0][::-1]
    return vertices, faces


def _fin() -> Mesh:
    vertices, faces = ball(1)
    vertices = np.concatenate([vertices, [[0, 0, 3.0]]])
    return _with(vertices, faces, add=[[*faces[0, :2], len(vertices) - 1]])


def _doubled_corner() -> Mesh:
    vertices, faces = ball(1)
    return _with(vertices, faces, add=[[faces[0, 0], faces[0, 0], faces[0, 1]]])


def _flattened(height: float) -> Mesh:
    """A ball with one vertex pushed onto the middle of an edge across from it, nearly."""
    vertices, faces = cubes((0, 0, 0))
    a, b, c = faces[0]
    vertices = np.concatenate([vertices, [(vertices[a] + vertices[b]) / 2]])
    vertices[-1] += height * (vertices[c] - vertices[a])
    new = len(vertices) - 1
    return vertices, np.concatenate([faces[1:], [[a, new, c], [new, b, c], [a, b, new]]])


DEFECTS: dict[str, tuple[Callable[[], Mesh], str, int]] = {
    "hole": (lambda: _with(ball(1)[0], ball(1)[1][1:]), "open_edges", 3),
    "fin": (_fin, "nonmanifold_edges", 1),
    "cubes on an edge": (lambda: cubes((0, 0, 0), (1, 1, 0)), "nonmanifold_edges", 1),
    "cubes on a corner": (lambda: cubes((0, 0, 0), (1, 1, 1)), "nonmanifold_vertices", 1),
    "turned face": (_turned, "inconsistent_edges", 3),
    "repeated corner": (_doubled_corner, "degenerate_faces", 1),
    "nearly flat face": (lambda: _flattened(0.3 * MIN_HEIGHT_SHARE), "degenerate_faces", 1),
    "not finite": (lambda: (np.concatenate([ball(1)[0][:-1], [[0, np.nan, 0]]]), ball(1)[1]),
                   "not_finite_vertices", 1),
    "unused": (lambda: (np.concatenate([ball(1)[0], [[9, 9, 9]]]), ball(1)[1]),
               "unused_vertices", 1),
    "index too large": (lambda: _with(*ball(1), add=[[0, 1, 10**6]]), "bad_indices", 1),
    "negative index": (lambda: _with(*ball(1), add=[[0, 1, -1]]), "bad_indices", 1),
}  # fmt: skip


@pytest.mark.parametrize("name", DEFECTS)
def test_every_defect_is_found_and_counted(name: str) -> None:
    make, count, wanted = DEFECTS[name]
    check = validate_manifold(*make())
    assert not check.good
    assert getattr(check, count) == wanted
    assert check.defects()
    told = json.loads(json.dumps(check.to_json(), allow_nan=False))
    assert told["good"] is False
    assert told["defects"] == check.defects()
    assert validate_manifold(*_flattened(3 * MIN_HEIGHT_SHARE)).good


def test_defects_do_not_hide_one_another() -> None:
    vertices, faces = joined(DEFECTS["hole"][0](), cubes((0, 0, 0), (1, 1, 0)), _turned())
    check = validate_manifold(np.concatenate([vertices, [[0, 0, 9.0]]]), faces)
    counts = (
        check.open_edges, check.nonmanifold_edges, check.inconsistent_edges, check.unused_vertices,
    )  # fmt: skip
    assert counts == (3, 1, 3, 1)
    assert len(check.parts) == 3
    assert {part.genus for part in check.parts} == {None}
    beside = joined(cubes((0, 0, 0), (1, 1, 1)), DEFECTS["hole"][0]())
    assert validate_manifold(*beside).nonmanifold_vertices == 1


def test_inside_out_and_empty_meshes_are_no_good() -> None:
    vertices, faces = ball(1)
    inside_out = validate_manifold(vertices, faces[:, ::-1])
    assert (inside_out.volume < 0, inside_out.good) == (True, False)
    assert inside_out.defects() == ["the enclosed volume is not positive"]
    for empty in (
        validate_manifold(np.zeros((0, 3)), np.zeros((0, 3))),
        validate_manifold(vertices, faces[:0]),
    ):
        assert (empty.good, empty.parts) == (False, ())
        assert "the mesh has no faces" in empty.defects()


def test_a_cavity_is_a_part_of_negative_volume() -> None:
    outer, inner = ball(2), ball(1)
    mesh = joined(outer, (0.5 * inner[0], inner[1][:, ::-1]))
    check = validate_manifold(*mesh)
    assert check.good
    assert [part.volume > 0 for part in check.parts] == [True, False]


def test_only_the_largest_parts_are_told_one_by_one() -> None:
    balls = [(ball(1)[0] + 3 * k, ball(1)[1]) for k in range(MAX_LISTED_PARTS + 5)]
    told = validate_manifold(*joined(ball(2), *balls)).to_json()
    assert told["part_count"] == MAX_LISTED_PARTS + 6
    assert len(told["parts"]) == MAX_LISTED_PARTS
    assert told["parts"][0]["faces"] == 320
