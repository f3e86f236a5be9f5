# SPDX-License-Identifier: GPL-3.0-or-later
"""Manifold check: it agrees with trimesh and finds every kind of defect."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import (
    MAX_LISTED_PARTS,
    MIN_HEIGHT_SHARE,
    mesh_statistics,
    validate_manifold,
)
from tests.core.meshing.cleanup.test_repair import cubes
from tests.core.meshing.closed_shapes import Mesh, ball, joined, lattice, noisy, ring, slab, wire

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


def _not_finite(value: float) -> Mesh:
    vertices, faces = ball(1)
    vertices[3, 1] = value
    return vertices, faces


DEFECTS: dict[str, tuple[Callable[[], Mesh], str, int]] = {
    "hole": (lambda: _with(ball(1)[0], ball(1)[1][1:]), "open_edges", 3),
    "fin": (_fin, "nonmanifold_edges", 1),
    "cubes on an edge": (lambda: cubes((0, 0, 0), (1, 1, 0)), "nonmanifold_edges", 1),
    "cubes on a corner": (lambda: cubes((0, 0, 0), (1, 1, 1)), "nonmanifold_vertices", 1),
    "turned face": (_turned, "inconsistent_edges", 3),
    "repeated corner": (_doubled_corner, "degenerate_faces", 1),
    "flat face": (lambda: _flattened(0.0), "degenerate_faces", 1),
    "nearly flat face": (lambda: _flattened(0.3 * MIN_HEIGHT_SHARE), "degenerate_faces", 1),
    "not a number": (lambda: _not_finite(np.nan), "not_finite_vertices", 1),
    "infinite": (lambda: _not_finite(np.inf), "not_finite_vertices", 1),
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


def test_a_face_a_little_higher_than_the_tolerance_is_none_of_them() -> None:
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


def test_corners_are_found_beside_other_defects_too() -> None:
    vertices, faces = joined(cubes((0, 0, 0), (1, 1, 1)), DEFECTS["hole"][0]())
    assert validate_manifold(vertices, faces).nonmanifold_vertices == 1


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
