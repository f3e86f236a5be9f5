# SPDX-License-Identifier: GPL-3.0-or-later
"""Repair of non-manifold and degenerate faces, floaters, and the statistics that report them."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.mesh.components import winding_number, without_floaters
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import mesh_statistics
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


def repaired_mesh(result: RepairResult) -> SurfaceMesh:
    return as_mesh(result.vertices, result.faces)


def test_one_cube_stays_as_it_is() -> None:
    vertices, faces = cubes((0, 0, 0))
    result = split_nonmanifold(vertices, faces)
    figures = assert_closed_manifold(repaired_mesh(result))
    assert (figures.euler, figures.genus, figures.volume) == (2, 0, pytest.approx(1.0))
    assert (result.split_vertices, result.split_edges) == (0, 0)
    np.testing.assert_array_equal(result.vertices[result.faces], vertices[faces])


def test_two_cubes_that_share_an_edge() -> None:
    vertices, faces = cubes((0, 0, 0), (1, 1, 0))
    before = mesh_statistics(as_mesh(vertices, faces))
    assert (before.nonmanifold_edges, before.closed) == (1, False)
    result = split_nonmanifold(vertices, faces)
    figures = assert_closed_manifold(repaired_mesh(result))
    assert (figures.components, figures.genus) == (2, 0)
    assert (result.split_vertices, result.split_edges) == (2, 0)
    assert figures.volume == pytest.approx(2.0, rel=0.05)
    # Merging equal points must not join the parts again.
    assert len(np.unique(np.round(result.vertices, 6), axis=0)) == len(result.vertices) == 16


def test_two_cubes_that_share_a_vertex() -> None:
    vertices, faces = cubes((0, 0, 0), (1, 1, 1))
    before = mesh_statistics(as_mesh(vertices, faces))
    assert (before.closed, before.nonmanifold_vertices, before.genus) == (True, 1, None)
    result = split_nonmanifold(vertices, faces)
    figures = assert_closed_manifold(repaired_mesh(result))
    assert (figures.components, figures.genus, result.split_vertices) == (2, 0, 1)


def test_edge_whose_both_ends_are_joined_elsewhere() -> None:
    # Two diagonal cells, joined above and below: around the edge both wedges belong together.
    cells = [(0, 0, 1), (1, 1, 1)]
    cells += [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 2)]
    vertices, faces = cubes(*cells)
    assert mesh_statistics(as_mesh(vertices, faces)).nonmanifold_edges == 1
    result = split_nonmanifold(vertices, faces)
    figures = assert_closed_manifold(repaired_mesh(result))
    assert result.split_edges == 2
    assert figures.components == 1
    assert figures.volume == pytest.approx(len(cells), rel=0.02)
    assert (result.origin == -1).sum() == 2


@pytest.mark.parametrize("seed", range(4))
def test_random_labels_of_tetrahedra_become_manifold(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(120, 3))
    points = np.concatenate([points, bounding_points(points, seed)])
    tetrahedra = delaunay(points, seed=seed, progress=Progress())
    inside = rng.random(len(tetrahedra)) < 0.5
    inside &= (tetrahedra < 120).all(1)
    faces = boundary_faces(tetrahedra, tetrahedron_neighbours(tetrahedra), inside)
    assert mesh_statistics(as_mesh(points, faces)).nonmanifold_edges > 20
    result = split_nonmanifold(points, faces)
    figures = assert_closed_manifold(repaired_mesh(result))
    corners = points[tetrahedra[inside]]
    exact = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6
    assert figures.volume == pytest.approx(exact, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_parts_repaired_one_after_another_are_the_whole_repaired(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(150, 3))
    points = np.concatenate([points, bounding_points(points, seed)])
    tetrahedra = delaunay(points, seed=seed, progress=Progress())
    inside = (rng.random(len(tetrahedra)) < 0.5) & (tetrahedra < 150).all(1)
    faces = boundary_faces(tetrahedra, tetrahedron_neighbours(tetrahedra), inside)
    whole = split_nonmanifold(points, faces)
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
    second = split_nonmanifold(vertices, np.concatenate([first.faces, number[far]]))
    figures = assert_closed_manifold(repaired_mesh(second))
    expected = mesh_statistics(repaired_mesh(whole))
    assert figures.components == expected.components
    assert first.split_vertices + second.split_vertices == whole.split_vertices
    assert figures.volume == pytest.approx(expected.volume, rel=0.02)


def test_open_faces_are_refused() -> None:
    vertices, faces = cubes((0, 0, 0))
    with pytest.raises(MeshingError, match="not closed"):
        split_nonmanifold(vertices, faces[1:])
    elsewhere = np.zeros(len(vertices), np.bool_)
    elsewhere[faces[0]] = True
    part = split_nonmanifold(vertices, faces[1:], elsewhere)
    np.testing.assert_array_equal(part.faces, faces[1:])
    elsewhere[faces[0][0]] = False
    with pytest.raises(MeshingError, match="not closed"):
        split_nonmanifold(vertices, faces[1:], elsewhere)


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
    begin, end, first, second = _an_edge_of_the_cube(vertices, faces)
    middle = len(vertices)
    vertices = np.concatenate([vertices, vertices[[begin, end]].mean(0)[None]])
    tip = int(next(v for v in faces[second] if v not in (begin, end)))
    divided = [[middle, begin, tip], [end, middle, tip], [end, begin, middle]]
    flat = np.concatenate([np.delete(faces, second, 0), divided])
    assert mesh_statistics(as_mesh(vertices, flat)).closed
    kept, left = remove_degenerate(vertices, flat, 1e-3, region)
    assert left == 0
    assert_closed_manifold(as_mesh(vertices, kept))
    assert middle in kept
    assert mesh_statistics(as_mesh(vertices, kept)).volume == pytest.approx(1.0, rel=1e-12)
    assert first != second


def _an_edge_of_the_cube(vertices: np.ndarray, faces: np.ndarray) -> tuple[int, int, int, int]:
    """Return begin and end of an edge of length 1, the face left of it, and the one beyond."""
    sides = {
        (int(a), int(b)): k
        for k, f in enumerate(faces)
        for a, b in zip(f, np.roll(f, -1), strict=False)
    }
    for (a, b), face in sides.items():
        if np.linalg.norm(vertices[a] - vertices[b]) < 1.1:
            return a, b, face, sides[b, a]
    raise AssertionError


def test_floaters_and_cavities_are_counted() -> None:
    shell = [(x, y, z) for x in range(3) for y in range(3) for z in range(3)]
    shell.remove((1, 1, 1))
    vertices, faces = cubes(*shell, (5, 0, 0), (7, 0, 0), (8, 0, 0))
    figures = assert_closed_manifold(as_mesh(vertices, faces))
    assert (figures.components, figures.volume) == (4, pytest.approx(26 + 3))
    result = without_floaters(vertices, faces, 0.15)  # areas 54, 6 (cavity), 6, 10
    assert (result.kept, result.removed_solids, result.removed_cavities) == (2, 1, 1)
    assert result.removed_area_share == pytest.approx(12 / 76)
    assert len(without_floaters(vertices, faces, 0.0).faces) == len(faces)


def test_the_largest_parts_stay_with_their_cavities() -> None:
    shell = [(x, y, z) for x in range(3) for y in range(3) for z in range(3)]
    shell.remove((1, 1, 1))
    vertices, faces = cubes(*shell, (5, 0, 0), (7, 0, 0), (8, 0, 0))
    one = without_floaters(vertices, faces, 0.0, 1)
    assert (one.kept, one.removed_solids, one.removed_cavities) == (2, 2, 0)
    assert mesh_statistics(as_mesh(vertices, one.faces)).volume == pytest.approx(26)
    assert one.removed_area_share == pytest.approx(16 / 76)
    two = without_floaters(
        vertices, faces, 0.0, 2
    )  # the one of two cubes is larger than that of one
    assert mesh_statistics(as_mesh(vertices, two.faces)).volume == pytest.approx(28)
    assert len(without_floaters(vertices, faces, 0.0, 9).faces) == len(faces)


def test_a_cavity_goes_with_its_solid() -> None:
    """Its box lies inside that of a larger solid, a ring around both."""
    shell = [(x, y, z) for x in range(3) for y in range(3) for z in range(3)]
    shell.remove((1, 1, 1))
    ring = [
        (x, y, 1) for x in range(-3, 6) for y in range(-3, 6) if max(abs(x - 1), abs(y - 1)) == 4
    ]
    vertices, faces = cubes(*shell, *ring)
    result = without_floaters(vertices, faces, 0.0, 1)
    assert (result.kept, result.removed_solids, result.removed_cavities) == (1, 1, 1)
    assert mesh_statistics(as_mesh(vertices, result.faces)).volume == pytest.approx(len(ring))


@pytest.mark.parametrize(
    ("point", "wanted"), [((0.3, 0.4, 0.5), 1.0), ((1.5, 0.5, 0.5), 0.0), ((9.0, 0.0, 0.0), 0.0)]
)
def test_winding_numbers(point: tuple[float, float, float], wanted: float) -> None:
    vertices, faces = cubes((0, 0, 0))
    at = vertices.min(0) + np.array(point)
    assert winding_number(at, vertices, faces) == pytest.approx(wanted, abs=1e-12)


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


def test_a_piece_of_wire_is_no_floater() -> None:
    block = [(x, y, z) for x in range(10) for y in range(10) for z in range(10)]
    wire = [(x, 20, 0) for x in range(4)]
    vertices, faces = cubes(*block, *wire, (30, 0, 0))
    result = without_floaters(vertices, faces, 0.05)  # areas 600, 18, 6; lengths 17.3, 4.2, 1.7
    assert (result.kept, result.removed_solids) == (2, 1)
    assert result.removed_area_share == pytest.approx(6 / 624)


def test_a_long_sliver_is_a_floater() -> None:
    """Four long faces are not a wire, however long they are."""
    vertices, faces = cubes((0, 0, 0), (1, 0, 0))
    sliver = np.array([[20.0, 0, 0], [28, 0, 0], [24, 0.002, 0], [24, 0, 0.002]])
    corners = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    both = np.concatenate([vertices, sliver]), np.concatenate([faces, corners + len(vertices)])
    assert mesh_statistics(as_mesh(*both)).closed
    result = without_floaters(*both, 0.01)
    assert len(result.faces) == len(faces)
    assert result.removed_solids == 1
