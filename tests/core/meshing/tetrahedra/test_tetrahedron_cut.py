# SPDX-License-Identifier: GPL-3.0-or-later
"""Tetrahedra clipped to a region fill it face to face, in any position."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.meshing.classification import (
    boundary_faces,
    tetrahedron_neighbours,
)
from gaussian_wrapping_addon.core.meshing.delaunay import bounding_points, delaunay, signed_volumes
from gaussian_wrapping_addon.core.meshing.marching_tetrahedra import CutTetrahedra, cut_to_region
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.meshing.meshing_scenes import cube


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
    corners = cut.points[hull]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
                          axis=1).sum() / 2  # fmt: skip
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
