# SPDX-License-Identifier: GPL-3.0-or-later
"""Marching tetrahedra and bisection."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import mesh_statistics
from gaussian_wrapping_addon.core.meshing.delaunay import bounding_points, delaunay
from gaussian_wrapping_addon.core.meshing.marching_tetrahedra import (
    bisect,
    case_tables,
    marching_tetrahedra,
)
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.meshing.meshing_scenes import assert_closed_manifold

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


@pytest.mark.parametrize("code", range(16))
def test_every_code_separates_inside_from_outside(code: int) -> None:
    inside = np.array([bool(code >> k & 1) for k in range(4)])
    edges, faces = marching_tetrahedra(np.arange(4)[None], inside)
    assert len(faces) == (0, 1, 2, 1, 0)[inside.sum()]
    assert inside[edges[:, 0]].all()
    assert not inside[edges[:, 1]].any()
    middle = CORNERS[edges].mean(1)
    for face in faces:
        normal = np.cross(*(middle[face[1:]] - middle[face[0]]))
        side = (CORNERS - middle[face[0]]) @ normal
        assert (side[~inside] > 0).all()
        assert (side[inside] < 0).all()


def test_odd_renumbering_of_a_positive_tetrahedron_keeps_the_orientation() -> None:
    for order in itertools.permutations(range(4)):
        points = CORNERS[list(order)]
        if np.linalg.det(points[1:] - points[0]) < 0:
            continue
        for code in range(1, 15):
            inside = np.array([bool(code >> k & 1) for k in range(4)])
            edges, faces = marching_tetrahedra(np.arange(4)[None], inside)
            middle = points[edges].mean(1)
            for face in faces:
                normal = np.cross(*(middle[face[1:]] - middle[face[0]]))
                assert ((points - middle[face[0]])[~inside] @ normal > 0).all()


def test_tables_cover_all_codes() -> None:
    counts, _ = case_tables()
    assert counts.tolist() == [0, 1, 1, 2, 1, 2, 2, 1, 1, 2, 2, 1, 2, 1, 1, 0]


@pytest.mark.parametrize("points", [2000, 16000])
def test_sphere_is_closed_and_its_volume_converges(points: int) -> None:
    cloud = np.random.default_rng(0).uniform(-1.2, 1.2, (points, 3))
    cloud = np.concatenate([cloud, bounding_points(cloud, 0)])
    tetrahedra = delaunay(cloud, seed=0, progress=Progress())
    empty = lambda p: np.linalg.norm(p, axis=1) > 0.8  # noqa: E731
    edges, faces = marching_tetrahedra(tetrahedra, ~empty(cloud))
    inside, outside = bisect(cloud[edges[:, 0]], cloud[edges[:, 1]], empty, 1e-5, Progress())
    assert not empty(inside).any()
    assert empty(outside).all()
    assert np.linalg.norm(inside - outside, axis=1).max() <= 1e-5
    vertices = (inside + outside) / 2
    mesh = SurfaceMesh(vertices, faces.astype(np.int32))
    figures = assert_closed_manifold(mesh)
    assert figures.euler == 2
    exact = 4 / 3 * np.pi * 0.8**3
    assert 0 < 1 - figures.volume / exact < 0.9 * points ** (-2 / 3) * 16


def test_sign_change_exactly_on_points_stays_closed() -> None:
    axis = np.linspace(-1, 1, 9)
    cloud = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    cloud = np.concatenate([cloud, bounding_points(cloud, 0)])
    tetrahedra = delaunay(cloud, seed=0, progress=Progress())
    empty = lambda p: np.abs(p).max(1) > 0.5  # noqa: E731 - points lie exactly on the boundary
    edges, faces = marching_tetrahedra(tetrahedra, ~empty(cloud))
    inside, outside = bisect(cloud[edges[:, 0]], cloud[edges[:, 1]], empty, 1e-3, Progress())
    mesh = SurfaceMesh((inside + outside) / 2, faces.astype(np.int32))
    figures = mesh_statistics(mesh)
    assert figures.closed
    assert figures.euler == 2
    assert figures.volume == pytest.approx(1.0, rel=0.02)


def test_no_sign_change_gives_no_faces() -> None:
    edges, faces = marching_tetrahedra(np.arange(4)[None], np.zeros(4, bool))
    assert edges.shape == (0, 2)
    assert faces.shape == (0, 3)
