# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes without caps: oriented, manifold and open on the region's planes alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.meshing.clean_up import split_fans, without_caps
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.surface_points import Field
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.meshing.closed_shapes import ball, joined, slab
from tests.core.meshing.meshing_scenes import (
    Distance,
    ShapeField,
    cube,
    gaussians_on,
    sphere,
    torus,
)

TURNED = Rotation.from_euler("xyz", [0.3, 0.7, 1.1]).as_matrix()


def mesh_from(vertices: np.ndarray, faces: np.ndarray) -> SurfaceMesh:
    return SurfaceMesh(vertices, faces.astype(np.int32))


def closed_mesh(distance: Distance, region: Region, settings: MeshingSettings) -> SurfaceMesh:
    field, arrays = ShapeField(distance, 0.05), gaussians_on(distance, region, 1500, 0.05)
    return mesh_region(
        Field(field, field, 1), arrays, field.cameras, region, settings, Progress(), seed=0
    )


@pytest.mark.parametrize("spacing", ["uniform", "adaptive"])
@pytest.mark.parametrize("shape", [sphere, torus])
def test_primal_adaptive_meshes(shape: Callable[[], Distance], spacing: str) -> None:
    region = Region.box("half", np.array([-0.1, -2, -2]), np.array([2, 2, 2]), TURNED)
    closed = closed_mesh(shape(), region, MeshingSettings(points=1500, spacing=spacing))
    mesh = without_caps(closed, region)
    check = validate_manifold(mesh.vertices, mesh.faces, region)
    assert check.defects() == []
    assert check.open_at_region == check.open_edges > 10
    assert mesh.provenance["boundary"] == "open"
    assert mesh.provenance["cap_faces_left_out"] == len(closed.faces) - len(mesh.faces) > 0
    # No face of the caps is left: each has a corner inside the region.
    assert (region.distance(mesh.vertices[mesh.faces].mean(1)) < -1e-9).all()
    assert validate_manifold(mesh.vertices, mesh.faces).defects()[0].startswith("edges have one")


@pytest.mark.parametrize("moved", [False, True])
def test_a_round_region_of_many_planes_is_not_left(moved: bool) -> None:
    """Neighbouring planes meet at shallow angles: a corner of one cap lies near the next plane."""
    body = Region("round", 0.8 * ball(2)[0] + [0.7, 0.0, 0.0])
    closed = closed_mesh(sphere(), body, MeshingSettings(points=3000, spacing="uniform"))
    assert body.distance(closed.vertices).max() < 1e-9
    if moved:  # as repair does with vertices at which parts touch
        inner = np.flatnonzero(np.abs(body.distance(closed.vertices)) < 1e-9)[::40]
        vertices = closed.vertices.copy()
        vertices[inner] += 1e-4 * (body.center - vertices[inner])
        closed = replace(closed, vertices=vertices)
    mesh = without_caps(closed, body)
    assert body.distance(mesh.vertices).max() < 1e-9
    check = validate_manifold(mesh.vertices, mesh.faces, body)
    if not moved:
        assert check.defects() == []
    assert check.open_edges > 50


def test_a_plate_through_the_region_falls_into_two_sheets() -> None:
    vertices, faces = slab((2, 2, 0.1), 0.2)
    low, high = vertices.min(0), vertices.max(0)
    region = Region.box("r", np.append(low[:2], -5), np.append(high[:2], 5))
    mesh = without_caps(mesh_from(vertices, faces), region)
    check = validate_manifold(mesh.vertices, mesh.faces, region)
    assert check.defects() == []
    assert [part.euler for part in check.parts] == [1, 1]


def test_small_pieces_left_by_opening_go_as_floaters_do() -> None:
    body, small = slab((2, 2, 2), 0.5), slab((0.05, 0.05, 0.05), 0.1)
    flat, long = slab((0.05, 0.05, 0.05), 0.1), slab((0.01, 0.5, 0.01), 0.1)
    vertices, faces = joined(
        body,
        (small[0] + [3, 0, 1.95], small[1]),  # within the region, but for a face
        (flat[0] + [0, 3, 1.95], flat[1]),
        (long[0] + [-3, 0, 1.99], long[1]),  # small in area alone
    )
    region = Region.box("r", np.full(3, -9.0), np.array([9.0, 9.0, 2.0]))
    whole = without_caps(mesh_from(vertices, faces), region)
    assert len(validate_manifold(whole.vertices, whole.faces, region).parts) == 4
    assert whole.provenance["removed_open_pieces"] == 0
    mesh = without_caps(mesh_from(vertices, faces), region, 0.01)
    check = validate_manifold(mesh.vertices, mesh.faces, region)
    assert check.defects() == []
    assert len(check.parts) == mesh.provenance["components"] == 2
    assert mesh.provenance["removed_open_pieces"] == 2
    areas = 5 * 0.01  # of each that goes; the others have 5 faces left as well
    total = 5 * 16 + 2 * areas + 0.02 * 1 * 3 + 2 * 0.02**2
    assert mesh.provenance["removed_open_area_share"] == pytest.approx(2 * areas / total)
    assert mesh.vertices[:, 0].min() < -2.9
    assert mesh.vertices[:, :2].max() <= 2.0
    # Whatever is asked for, the largest piece stays.
    assert len(without_caps(mesh_from(vertices, faces), region, 1.0).faces) == len(body[1]) * 5 // 6


def test_a_mesh_within_its_region_stays_and_a_region_within_the_solid_leaves_nothing() -> None:
    vertices, faces = slab((2, 2, 2), 0.5)
    mesh = without_caps(mesh_from(vertices, faces), cube(3.0))
    assert len(mesh.faces) == len(faces)
    assert validate_manifold(mesh.vertices, mesh.faces).good
    assert mesh.provenance["cap_faces_left_out"] == 0
    region = Region.box("deep", vertices.min(0), vertices.max(0))
    with pytest.raises(MeshingError, match="'deep' lies within a solid"):
        without_caps(mesh_from(vertices, faces), region)


def test_vertices_that_repair_moved_go_back_to_the_plane() -> None:
    vertices, faces = slab((2, 2, 2), 0.25)
    low, high = vertices.min(0), vertices.max(0)
    region = Region.box("r", np.array([low[0], low[1] - 1, low[2] - 1]), high + 1)
    inner = np.flatnonzero((vertices[:, 0] == low[0]) & (np.abs(vertices[:, 1:]).max(1) < 0.6))
    moved = vertices.copy()
    moved[inner[0], 0] += 0.001
    mesh = without_caps(mesh_from(moved, faces), region)
    assert validate_manifold(mesh.vertices, mesh.faces, region).defects() == []
    assert len(mesh.faces) == len(without_caps(mesh_from(vertices, faces), region).faces)


def test_fans_that_meet_in_one_vertex_are_parted() -> None:
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    split, source = split_fans(faces)
    assert len(source) == 6
    assert np.array_equal(source[split], faces)
    _, source = split_fans(np.array([[0, 1, 2], [0, 2, 3]]))
    assert len(source) == 4


def test_open_edges_elsewhere_are_defects() -> None:
    vertices, faces = slab((2, 2, 2), 0.5)
    region = Region.box("r", vertices.min(0) - [0, 1, 1], vertices.max(0) + 1)
    mesh = without_caps(mesh_from(vertices, faces), region)
    hole = validate_manifold(mesh.vertices, np.delete(mesh.faces, len(mesh.faces) // 2, 0), region)
    assert hole.open_edges > hole.open_at_region
    assert not hole.good
    assert "edges have one face only" in hole.defects()[0]
    assert hole.to_json()["open_at_region"] == hole.open_at_region
