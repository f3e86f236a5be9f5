# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangles are joined to the polygons that they were cut from, as far as their UVs agree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.mesh.textured_mesh import (
    JoinedMesh,
    Polygons,
    join_triangles,
    read_polygons,
    write_polygons,
)

# A pentagon, a quad and a triangle in a row; the pentagon's triangles begin at different loops.
CORNERS = [[0, 1, 2, 3, 4], [2, 1, 5, 6], [6, 5, 7]]
LOOPS = np.array([[0, 1, 2], [4, 0, 2], [2, 3, 4], [5, 6, 7], [7, 8, 5], [9, 10, 11]])
OF_FACES = np.array([0, 0, 0, 1, 1, 2])
VERTEX_OF_LOOP = np.concatenate(CORNERS)
FACES = VERTEX_OF_LOOP[LOOPS]
UV_OF_LOOP = np.arange(24, dtype=np.float32).reshape(12, 2) / 24.0
CORNER_UVS = UV_OF_LOOP[LOOPS]


def corners_of(joined: JoinedMesh) -> list[list[int]]:
    return [part.tolist() for part in np.split(joined.corners, joined.starts[1:])]


def test_polygons_come_back_with_their_corners_and_uvs() -> None:
    order = np.array([3, 0, 5, 1, 4, 2])  # the order of the triangles does not matter
    joined = join_triangles(
        FACES[order], CORNER_UVS[order], Polygons(OF_FACES[order], LOOPS[order])
    )
    assert corners_of(joined) == CORNERS
    assert np.array_equal(joined.uvs, UV_OF_LOOP)


def test_a_polygon_that_a_seam_cuts_stays_triangles() -> None:
    uvs = CORNER_UVS.copy()
    uvs[4] += 0.25
    joined = join_triangles(FACES, uvs, Polygons(OF_FACES, LOOPS))
    assert corners_of(joined) == [CORNERS[0], CORNERS[2], [2, 1, 5], [5, 6, 2]]
    assert np.array_equal(joined.uvs[joined.starts[3] :], uvs[4])


def test_welded_corners_make_triangles_and_flat_ones_are_left_out() -> None:
    faces = np.where(FACES == 6, 5, FACES)  # the quad's corners 5 and 6 are at one place
    joined = join_triangles(faces, CORNER_UVS, Polygons(OF_FACES, LOOPS))
    assert corners_of(joined) == [CORNERS[0], [2, 1, 5]]


def test_polygons_wound_the_other_way_stay_triangles() -> None:
    """Their loops would turn the faces round."""
    faces, uvs = FACES[:, ::-1], CORNER_UVS[:, ::-1]
    joined = join_triangles(faces, uvs, Polygons(OF_FACES, LOOPS[:, ::-1]))
    assert corners_of(joined) == faces.tolist()


def test_a_file_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "polygons.npz"
    write_polygons(path, Polygons(OF_FACES, LOOPS))
    found = read_polygons(path, len(FACES))
    assert np.array_equal(found.of_faces, OF_FACES)
    assert np.array_equal(found.loops, LOOPS)


@pytest.mark.parametrize(
    ("polygons", "loops"),
    [
        (OF_FACES[:-1], LOOPS),
        (OF_FACES, LOOPS[:-1]),
        (OF_FACES.astype(float), LOOPS),
        (OF_FACES, LOOPS - 1),
        (OF_FACES + 10**9, LOOPS),
    ],
)
def test_a_file_of_another_mesh_is_refused(
    polygons: np.ndarray, loops: np.ndarray, tmp_path: Path
) -> None:
    write_polygons(tmp_path / "polygons.npz", Polygons(polygons, loops))
    with pytest.raises(ParseError, match="not of this mesh"):
        read_polygons(tmp_path / "polygons.npz", len(FACES))
