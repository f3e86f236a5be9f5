# SPDX-License-Identifier: GPL-3.0-or-later
"""Normals, areas, edges, polygons and UDIM tiles of meshes whose values are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.mesh.surface_mesh import (
    area_vectors,
    edge_keys,
    edge_lengths,
    normals_and_areas,
)
from gaussian_wrapping_addon.core.mesh.textured_mesh import (
    FIRST_UDIM,
    LAST_UDIM,
    JoinedMesh,
    Polygons,
    join_triangles,
    read_polygons,
    udim_uvs,
    write_polygons,
)

# A right triangle with legs 3 and 4 in z = 1, one without area, and a neighbour of the first.
VERTICES = np.array([[0, 0, 1], [3, 0, 1], [0, 4, 1], [6, 0, 1], [3, 4, 1]], np.float64)
FACES = np.array([[0, 1, 2], [0, 3, 1], [2, 1, 4]])


def test_normals_areas_and_edges() -> None:
    normals, areas = normals_and_areas(VERTICES, FACES)
    np.testing.assert_array_equal(normals, [[0, 0, 1], [0, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(areas, [6, 0, 6])
    np.testing.assert_array_equal(area_vectors(VERTICES, FACES[:, ::-1])[:, 2], [-12, 0, -12])
    np.testing.assert_array_equal(edge_lengths(VERTICES, FACES[:1]), [[3, 5, 4]])
    for dtype in (np.float32, np.float64):
        assert area_vectors(VERTICES.astype(dtype), FACES).dtype == dtype


def test_edge_keys_have_no_direction_and_do_not_overflow() -> None:
    for dtype in (np.int32, np.int64):
        begin, end = np.array([7, 2_000_000], dtype), np.array([1_999_999, 3], dtype)
        keys = edge_keys(begin, end, 3_000_000)
        assert keys.dtype == np.int64
        np.testing.assert_array_equal(keys, edge_keys(end, begin, 3_000_000))
        np.testing.assert_array_equal(np.divmod(keys, 3_000_000), [[7, 3], [1_999_999, 2_000_000]])


# A pentagon, a quad and a triangle in a row; the pentagon's triangles begin at different loops.
CORNERS = [[0, 1, 2, 3, 4], [2, 1, 5, 6], [6, 5, 7]]
LOOPS = np.array([[0, 1, 2], [4, 0, 2], [2, 3, 4], [5, 6, 7], [7, 8, 5], [9, 10, 11]])
OF_FACES = np.array([0, 0, 0, 1, 1, 2])
VERTEX_OF_LOOP = np.concatenate(CORNERS)
FACES_OF_SIX = VERTEX_OF_LOOP[LOOPS]
UV_OF_LOOP = np.arange(24, dtype=np.float32).reshape(12, 2) / 24.0
CORNER_UVS = UV_OF_LOOP[LOOPS]


def corners_of(joined: JoinedMesh) -> list[list[int]]:
    return [part.tolist() for part in np.split(joined.corners, joined.starts[1:])]


def test_polygons_come_back_with_their_corners_and_uvs() -> None:
    order = np.array([3, 0, 5, 1, 4, 2])  # the order of the triangles does not matter
    joined = join_triangles(
        FACES_OF_SIX[order], CORNER_UVS[order], Polygons(OF_FACES[order], LOOPS[order])
    )
    assert corners_of(joined) == CORNERS
    assert np.array_equal(joined.uvs, UV_OF_LOOP)


def test_a_polygon_that_a_seam_cuts_stays_triangles() -> None:
    uvs = CORNER_UVS.copy()
    uvs[4] += 0.25
    joined = join_triangles(FACES_OF_SIX, uvs, Polygons(OF_FACES, LOOPS))
    assert corners_of(joined) == [CORNERS[0], CORNERS[2], [2, 1, 5], [5, 6, 2]]
    assert np.array_equal(joined.uvs[joined.starts[3] :], uvs[4])


def test_welded_corners_make_triangles_and_flat_ones_are_left_out() -> None:
    faces = np.where(
        FACES_OF_SIX == 6, 5, FACES_OF_SIX
    )  # the quad's corners 5 and 6 are at one place
    joined = join_triangles(faces, CORNER_UVS, Polygons(OF_FACES, LOOPS))
    assert corners_of(joined) == [CORNERS[0], [2, 1, 5]]


def test_polygons_wound_the_other_way_stay_triangles() -> None:
    """Their loops would turn the faces round."""
    faces, uvs = FACES_OF_SIX[:, ::-1], CORNER_UVS[:, ::-1]
    joined = join_triangles(faces, uvs, Polygons(OF_FACES, LOOPS[:, ::-1]))
    assert corners_of(joined) == faces.tolist()


def test_a_file_comes_back_and_one_of_another_mesh_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "polygons.npz"
    write_polygons(path, Polygons(OF_FACES, LOOPS))
    found = read_polygons(path, len(FACES_OF_SIX))
    assert np.array_equal(found.of_faces, OF_FACES)
    assert np.array_equal(found.loops, LOOPS)
    for polygons, loops in (
        (OF_FACES[:-1], LOOPS),
        (OF_FACES, LOOPS[:-1]),
        (OF_FACES.astype(float), LOOPS),
        (OF_FACES, LOOPS - 1),
        (OF_FACES + 10**9, LOOPS),
    ):
        write_polygons(path, Polygons(polygons, loops))
        with pytest.raises(ParseError, match="not of this mesh"):
            read_polygons(path, len(FACES_OF_SIX))


def test_uvs_move_to_the_tiles_of_their_atlases() -> None:
    uvs = np.random.default_rng(0).random((3, 3, 2)).astype(np.float32)
    moved = udim_uvs(uvs, np.array([0, 2, 1]), (FIRST_UDIM, 1013, LAST_UDIM))
    assert moved.dtype == np.float32
    assert np.array_equal(np.floor(moved).mean(1), [[0, 0], [9, 99], [2, 1]])
    assert np.abs(moved - np.floor(moved) - uvs).max() < 1e-5
    assert np.array_equal(udim_uvs(uvs, None, (1002,)), uvs + np.float32([1, 0]))
