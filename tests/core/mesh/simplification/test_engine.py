# SPDX-License-Identifier: GPL-3.0-or-later
"""Quadrics, link condition and merging on meshes small enough to count by hand."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.edge_collapse import (
    DONE,
    FULL,
    MAX_RING,
    PAUSED,
    VERTICES_LEFT,
    WEIGHT,
    error_of_both,
    error_of_one,
    link_allows,
    mark_ring,
    merge_vertices,
    unlink_dead_faces,
)
from gaussian_wrapping_addon.core.mesh.simplification import Heap, Simplification, select_vertices
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
RNG = np.random.default_rng(0)


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


def test_no_edge_of_a_tetrahedron_may_collapse() -> None:
    run = started(RNG.normal(size=(4, 3)), TETRAHEDRON)
    assert not any(allowed(run, u, v) for u in range(4) for v in range(4) if u != v)


def test_a_loop_of_three_edges_without_a_face_may_not_close() -> None:
    run = started(*bipyramid(3))
    assert not allowed(run, 0, 1), "their common neighbours are both tips and the third of the rim"
    assert allowed(run, 0, 3)
    assert allowed(run, 3, 0)


def test_marks_of_one_ring_serve_several_neighbours() -> None:
    run = started(*bipyramid(5))
    around, mark = mark_ring(0, run.mesh, run.counts, np.empty(0, np.int64))
    found = [
        bool(link_allows(0, v, around, mark, MAX_RING, run.mesh, run.counts)) for v in (1, 4, 5, 6)
    ]
    assert found == [True] * 4
    assert not link_allows(0, 2, around, mark, MAX_RING, run.mesh, run.counts), "not neighbours"


def test_a_merged_vertex_has_no_more_faces_than_asked_for() -> None:
    run = started(*bipyramid(9))
    assert allowed(run, 9, 0, max_ring=9)
    assert not allowed(run, 9, 0, max_ring=8), "nine faces and four, less two that go, twice"


def test_merging_keeps_a_closed_manifold() -> None:
    points, faces = bipyramid(8)
    run = started(points, faces)
    before = run.mesh[4].copy()
    for vertex in (2, 3):
        unlink_dead_faces(vertex, *run.mesh[1:4])
    merge_vertices(2, 3, run.mesh, run.counts)
    check = validate_manifold(points, run.faces())
    assert (check.open_edges, check.nonmanifold_edges, check.inconsistent_edges) == (0, 0, 0)
    assert (check.nonmanifold_vertices, check.euler) == (0, 2)
    assert run.faces_left == len(run.faces()) == len(faces) - 2
    assert run.counts[VERTICES_LEFT] == len(points) - 1
    np.testing.assert_array_equal(run.mesh[4][2], before[2] + before[3])
    assert not (run.faces() == 3).any()


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
    tip = len(points) - 1
    face = faces[(faces == tip).any(1)][0]
    a, b, c = face
    mid, other = len(points), len(points) + 1
    points = np.concatenate([points, [points[face].mean(0)]])
    faces = np.array([f for f in faces.tolist() if f != face.tolist()])
    faces = np.concatenate([faces, [[a, b, mid], [b, c, mid], [c, a, mid]]])
    # A second one beside the first brings the tip to the number of faces asked for.
    next_face = faces[(faces == tip).any(1) & (faces != mid).all(1)][0]
    a, b, c = next_face
    points = np.concatenate([points, [points[next_face].mean(0)]])
    faces = np.array([f for f in faces.tolist() if f != next_face.tolist()])
    faces = np.concatenate([faces, [[a, b, other], [b, c, other], [c, a, other]]])
    assert (faces == tip).sum() == around
    run = started(points, faces)
    limit = MAX_RING - 1  # for a vertex with three faces, as half-edge collapses ask
    assert allowed(run, mid, tip, limit) is goes


def test_selection_of_a_mesh_in_another_memory_order_is_the_same() -> None:
    points, faces = bipyramid(40)
    chosen = select_vertices(points, faces, 12, 10.0)
    turned = select_vertices(points, np.asfortranarray(faces), 12, 10.0)
    assert 0 < len(chosen) < len(faces)
    np.testing.assert_array_equal(chosen, turned)
