# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertex selection on dense closed meshes of known shapes."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from gaussian_wrapping_addon.core.mesh.components import compacted
from gaussian_wrapping_addon.core.mesh.simplification import (
    Units,
    left_of,
    merge_vertices,
    quadrics_of,
    select_vertices,
)
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from tests.core.field.field_scenes import unit_sphere
from tests.core.meshing.meshing_scenes import assert_closed_manifold, torus


def hull(points: np.ndarray) -> np.ndarray:
    """Return the faces of the convex hull of points around 0, outward."""
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(1) < 0
    faces[inward] = faces[inward][:, [0, 2, 1]]
    return faces


@functools.lru_cache(maxsize=1)
def ball() -> tuple[np.ndarray, np.ndarray]:
    points = unit_sphere(3000)
    return points, hull(points)


def ring(around: int, across: int) -> tuple[np.ndarray, np.ndarray]:
    """A torus of quads split in two."""
    u, v = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    big, small = 2 * np.pi * u / around, 2 * np.pi * v / across
    reach = 1 + 0.35 * np.cos(small)
    points = np.stack([reach * np.cos(big), reach * np.sin(big), 0.35 * np.sin(small)], -1)
    right, up = (u + 1) % around, (v + 1) % across
    a, b = u * across + v, right * across + v
    c, d = right * across + up, u * across + up
    quads = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    return points.reshape(-1, 3), quads


def selected(
    points: np.ndarray, faces: np.ndarray, target: int, longest: float = 10.0
) -> SurfaceMesh:
    vertices, chosen, _ = compacted(points, select_vertices(points, faces, target, longest))
    return SurfaceMesh(vertices, chosen.astype(np.int32), {})


def test_vertices_stay_in_place_and_genus_stays() -> None:
    points, faces = ring(120, 60)
    mesh = selected(points, faces, 400)
    figures = assert_closed_manifold(mesh)
    assert (figures.vertices, figures.genus, figures.components) == (400, 1, 1)
    assert np.abs(torus()(mesh.vertices)).max() < 1e-12
    assert figures.volume == pytest.approx(2 * np.pi**2 * 0.35**2, rel=0.04)


def test_small_sphere_gets_the_share_of_its_curvature() -> None:
    points, faces = ball()
    both = np.concatenate([points, 0.1 * points + [3, 0, 0]])
    mesh = selected(both, np.concatenate([faces, faces + len(points)]), 600)
    figures = assert_closed_manifold(mesh)
    assert figures.components == 2
    # Edges go with the third root of the radius, so a tenth of it gets 4.6 times the density.
    small = (mesh.vertices[:, 0] > 2).sum()
    assert small == pytest.approx(600 * 0.1 ** (4 / 3) / (1 + 0.1 ** (4 / 3)), rel=0.3)


def test_long_edges_are_not_made() -> None:
    points, faces = ball()
    mesh = selected(points, faces, 10, longest=0.3)
    assert_closed_manifold(mesh)
    corners = mesh.vertices[mesh.faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() <= 0.3
    assert len(mesh.vertices) > 100


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_scale_and_place_do_not_matter(scale: float) -> None:
    points, faces = ball()
    moved = scale * points + scale * np.array([5e5, 4e6, 0.0])
    here = select_vertices(points, faces, 500, 1.0)
    there = select_vertices(moved, faces, 500, scale)
    assert assert_closed_manifold(selected(points, there, 500)).genus == 0
    assert len(np.unique(here)) == len(np.unique(there)) == 500


def test_nothing_goes_below_a_tetrahedron_and_few_vertices_stay_as_they_are() -> None:
    points, faces = ball()
    smallest = selected(points, faces, 0)
    assert assert_closed_manifold(smallest).genus == 0
    assert 4 <= len(smallest.vertices) < 40
    np.testing.assert_array_equal(select_vertices(points, faces, 3000, 1.0), faces)


def part_of_ring() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half of a torus, open; its vertices with other faces elsewhere, (v,) bool."""
    points, faces = ring(60, 30)
    half = faces[(points[faces][:, :, 0] > 0).all(1)]
    elsewhere = np.zeros(len(points), np.bool_)
    elsewhere[faces[(points[faces][:, :, 0] <= 0).any(1)]] = True
    vertices, half, source = compacted(points, half)
    return vertices, half, elsewhere[source]


UNITS = Units(np.zeros(3), 3.0)


def test_locked_vertices_stay_and_others_merge_only_among_themselves() -> None:
    vertices, faces, locked = part_of_ring()
    merged = merge_vertices(vertices, faces, UNITS, 0, 10.0, locked=locked)
    gone = merged.into >= 0
    assert gone.sum() > 0.5 * (~locked).sum()
    assert not locked[gone].any()
    assert not locked[merged.into[gone]].any()
    np.testing.assert_array_equal(gone, np.isfinite(merged.level))

    def outline(faces: np.ndarray) -> set[tuple[int, int]]:
        edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()
        return {(a, b) for a, b in edges} - {(b, a) for a, b in edges}

    assert outline(merged.faces) == outline(faces)
    assert len(outline(faces)) == 60


def test_mergers_up_to_a_level_are_those_of_a_run_that_ends_there() -> None:
    vertices, faces, locked = part_of_ring()
    merged = merge_vertices(vertices, faces, UNITS, 0, 10.0, locked=locked)
    levels = np.sort(merged.level[np.isfinite(merged.level)])
    for level in levels[[0, len(levels) // 3, -1]].tolist():
        stands = left_of(merged.into, merged.level, level)
        replaced = stands[faces]
        a, b, c = replaced.T
        replaced = replaced[(a != b) & (b != c) & (c != a)]
        short = merge_vertices(vertices, faces, UNITS, 0, 10.0, locked=locked, most=level)
        np.testing.assert_array_equal(replaced, short.faces)
        summed = np.zeros_like(short.quadrics)
        np.add.at(summed, stands, quadrics_of(vertices, faces, UNITS))
        kept = np.unique(short.faces)
        np.testing.assert_allclose(summed[kept], short.quadrics[kept], rtol=1e-9, atol=1e-12)


def test_given_quadrics_are_those_that_count() -> None:
    points, faces = ball()
    units = Units(np.zeros(3), 2.0)
    plain = merge_vertices(points, faces, units, 500, 10.0)
    given = quadrics_of(points, faces, units)
    same = merge_vertices(points, faces, units, 500, 10.0, quadrics=given)
    np.testing.assert_array_equal(same.faces, plain.faces)
    heavy = points[:, 2] > 0
    other = merge_vertices(
        points, faces, units, 500, 10.0, quadrics=np.where(heavy[:, None], 100.0, 1.0) * given
    )
    upper = (points[np.unique(other.faces), 2] > 0).sum()
    assert upper > 1.5 * (points[np.unique(plain.faces), 2] > 0).sum()
