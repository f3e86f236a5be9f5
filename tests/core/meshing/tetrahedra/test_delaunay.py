# SPDX-License-Identifier: GPL-3.0-or-later
"""Delaunay tetrahedra of hard inputs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.meshing import delaunay as module
from gaussian_wrapping_addon.core.meshing.classification import tetrahedron_neighbours
from gaussian_wrapping_addon.core.meshing.delaunay import bounding_points, delaunay, signed_volumes
from gaussian_wrapping_addon.core.progress import Progress

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
    points = np.concatenate([HARD[name], bounding_points(HARD[name], 0)])
    check(points, delaunay(points, seed=0, progress=Progress()))


def test_empty_circumspheres() -> None:
    points = HARD["random"][:200]
    tetrahedra = delaunay(points, seed=0, progress=Progress())
    a = points[tetrahedra[:, 0]]
    edges = points[tetrahedra[:, 1:]] - a[:, None]  # (m, 3, 3)
    offset = np.linalg.solve(edges, 0.5 * (edges**2).sum(2)[..., None])[..., 0]
    distance = np.linalg.norm(points[None] - (a + offset)[:, None], axis=2)
    radius = np.linalg.norm(offset, axis=1)
    assert (distance > radius[:, None] - 1e-3).all()


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_points_are_refused(count: int) -> None:
    with pytest.raises(MeshingError, match="no tetrahedron") as caught:
        delaunay(np.zeros((9, 3))[:count], seed=0, progress=Progress())
    assert caught.value.hint
    with pytest.raises(MeshingError, match="no tetrahedron"):
        delaunay(np.ones((50, 3)), seed=0, progress=Progress())
    with pytest.raises(MeshingError, match="finite"):
        delaunay(np.full((5, 3), np.inf), seed=0, progress=Progress())


def test_fallback_in_a_helper_process(monkeypatch: pytest.MonkeyPatch) -> None:
    import shull

    def refuse(points: np.ndarray) -> None:
        raise ValueError("points are degenerate")

    monkeypatch.setattr(shull, "Delaunay3d", refuse)
    points = np.concatenate([HARD["lattice"], bounding_points(HARD["lattice"], 0)])
    check(points, delaunay(points, seed=0, progress=Progress()))


def test_fallback_reports_points_it_cannot_connect() -> None:
    with pytest.raises(Exception, match="could not be triangulated") as caught:
        module.qhull_tetrahedra(np.full((10, 3), np.nan), Progress())
    assert caught.value.hint  # type: ignore[attr-defined]


def test_seed_decides_the_result() -> None:
    points = np.concatenate([HARD["lattice"], bounding_points(HARD["lattice"], 0)])
    first, again, other = (delaunay(points, seed=s, progress=Progress()) for s in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or (first != other).any()
