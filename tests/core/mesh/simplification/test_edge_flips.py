# SPDX-License-Identifier: GPL-3.0-or-later
"""Edges flipped towards a dense mesh of the same surface."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from gaussian_wrapping_addon.core.mesh.components import compacted
from gaussian_wrapping_addon.core.mesh.sampling import sample_triangles
from gaussian_wrapping_addon.core.mesh.simplification import flip_edges, select_vertices
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from tests.core.field.field_scenes import unit_sphere
from tests.core.mesh.simplification.test_vertex_selection import ring
from tests.core.meshing.meshing_scenes import assert_closed_manifold, torus


def hull(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on a sphere and the faces of their convex hull, outward."""
    points = unit_sphere(count)
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(1) < 0
    faces[inward] = faces[inward][:, [0, 2, 1]]
    return points, faces


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


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-3, 0.0), (1e4, 0.0), (1.0, 1e4)])
def test_turned_edges_turn_back(scale: float, offset: float) -> None:
    points, faces = hull(150)
    where = scale * points + offset
    turned = flipped(faces, 20)
    assert len(face_set(turned) & face_set(faces)) == len(faces) - 40
    again = flip_edges(where, turned, where, faces, 10.0 * scale)
    assert face_set(again) == face_set(faces)


def test_error_falls_and_the_shape_stays_closed() -> None:
    points, faces = ring(120, 60)
    vertices, coarse, _ = compacted(points, select_vertices(points, faces, 400, 10.0))
    better = flip_edges(vertices, coarse, points, faces, 10.0)
    errors = []
    for each in (coarse, better):
        figures = assert_closed_manifold(SurfaceMesh(vertices, each.astype(np.int32), None, {}))
        assert (figures.vertices, figures.genus, figures.components) == (400, 1, 1)
        where, _ = sample_triangles(vertices, each, 40_000, np.random.default_rng(0))
        errors.append(np.abs(torus()(where)).mean())
    assert errors[1] < 0.95 * errors[0]


def test_no_edge_becomes_longer_than_allowed() -> None:
    points, faces = ring(120, 60)
    vertices, coarse, _ = compacted(points, select_vertices(points, faces, 400, 10.0))
    before = {tuple(sorted(e)) for f in coarse.tolist() for e in zip(f, f[1:] + f[:1], strict=True)}
    better = flip_edges(vertices, coarse, points, faces, 0.25)
    after = {tuple(sorted(e)) for f in better.tolist() for e in zip(f, f[1:] + f[:1], strict=True)}
    made = np.array(sorted(after - before))
    assert len(made)
    assert np.linalg.norm(vertices[made[:, 0]] - vertices[made[:, 1]], axis=1).max() <= 0.25


def test_what_fits_already_and_what_is_flat_stays() -> None:
    points, faces = hull(200)
    np.testing.assert_array_equal(flip_edges(points, faces, points, faces, 10.0), faces)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
    box = ConvexHull(corners).simplices.astype(np.int64)
    a, b, c = (corners[box[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * (a - 0.5)).sum(1) < 0
    box[inward] = box[inward][:, [0, 2, 1]]
    np.testing.assert_array_equal(flip_edges(corners, box, corners, box, 10.0), box)
    none = np.zeros((0, 3), np.int64)
    assert flip_edges(np.zeros((0, 3)), none, points, faces, 1.0).shape == (0, 3)


def test_a_part_is_flipped_like_the_whole_and_nothing_else() -> None:
    points, faces = ring(120, 60)
    vertices, coarse, _ = compacted(points, select_vertices(points, faces, 400, 10.0))
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
    figures = assert_closed_manifold(SurfaceMesh(vertices, part.astype(np.int32), None, {}))
    assert (figures.vertices, figures.genus, figures.components) == (400, 1, 1)
