# SPDX-License-Identifier: GPL-3.0-or-later
"""Normals, areas and edges of meshes whose values are known."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.surface_mesh import (
    area_vectors,
    edge_keys,
    edge_lengths,
    faces_per_edge,
    half_edges,
    next_half_edges,
    normals_and_areas,
    vertices_of_half_edges,
)

# A right triangle with legs 3 and 4 in z = 1, one without area, and a neighbour of the first.
VERTICES = np.array([[0, 0, 1], [3, 0, 1], [0, 4, 1], [6, 0, 1], [3, 4, 1]], np.float64)
FACES = np.array([[0, 1, 2], [0, 3, 1], [2, 1, 4]])


def test_normals_are_unit_and_zero_without_area() -> None:
    normals, areas = normals_and_areas(VERTICES, FACES)
    np.testing.assert_array_equal(normals, [[0, 0, 1], [0, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(areas, [6, 0, 6])
    np.testing.assert_array_equal(area_vectors(VERTICES, FACES)[:, 2], [12, 0, 12])


def test_a_reversed_face_has_the_opposite_normal() -> None:
    normals, areas = normals_and_areas(VERTICES, FACES[:1, ::-1])
    assert normals[0, 2] == -1
    assert areas[0] == 6


def test_precision_is_that_of_the_vertices() -> None:
    assert area_vectors(VERTICES.astype(np.float32), FACES).dtype == np.float32
    assert area_vectors(VERTICES, FACES).dtype == np.float64


def test_edge_lengths_start_at_their_corner() -> None:
    np.testing.assert_array_equal(edge_lengths(VERTICES, FACES[:1]), [[3, 5, 4]])


def test_half_edges_follow_one_another_around_a_face() -> None:
    begin, end = half_edges(FACES)
    np.testing.assert_array_equal(begin, [0, 1, 2, 0, 3, 1, 2, 1, 4])
    half = np.arange(FACES.size)
    np.testing.assert_array_equal(begin[next_half_edges(half)], end)
    np.testing.assert_array_equal(next_half_edges(half), [1, 2, 0, 4, 5, 3, 7, 8, 6])


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_edge_keys_have_no_direction_and_do_not_overflow(dtype: type) -> None:
    begin, end = np.array([7, 2_000_000], dtype), np.array([1_999_999, 3], dtype)
    keys = edge_keys(begin, end, 3_000_000)
    assert keys.dtype == np.int64
    np.testing.assert_array_equal(keys, edge_keys(end, begin, 3_000_000))
    np.testing.assert_array_equal(keys // 3_000_000, [7, 3])
    np.testing.assert_array_equal(keys % 3_000_000, [1_999_999, 2_000_000])


def test_open_edges_have_one_face() -> None:
    count = faces_per_edge(FACES, 5)
    np.testing.assert_array_equal(count, [2, 2, 1, 1, 1, 2, 2, 1, 1])
    np.testing.assert_array_equal(
        vertices_of_half_edges(count == 2, FACES, 5), [True, True, True, False, False]
    )
