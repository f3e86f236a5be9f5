# SPDX-License-Identifier: GPL-3.0-or-later
"""Small handles are closed; openings, tubes and all else are kept."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.components import compacted
from gaussian_wrapping_addon.core.meshing import clean_up
from gaussian_wrapping_addon.core.meshing.checks import ManifoldCheck, validate_manifold
from gaussian_wrapping_addon.core.meshing.clean_up import without_small_handles

QUADS = {
    (0, 1): [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)],
    (0, -1): [(0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)],
    (1, 1): [(0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)],
    (1, -1): [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)],
    (2, 1): [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
    (2, -1): [(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)],
}


def surface_of(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of filled cubes of side 1, two triangles a square."""
    padded = np.pad(cells, 1)
    quads = []
    for (axis, way), corners in QUADS.items():
        bare = padded & ~np.roll(padded, -way, axis)
        at = np.argwhere(bare) - 1
        quads.append(at[:, None] + np.array(corners))
    points = np.concatenate(quads)  # (q, 4, 3)
    vertices, index = np.unique(points.reshape(-1, 3), axis=0, return_inverse=True)
    index = index.reshape(-1, 4)
    # Not quite flat: a disc over three points of a line would have faces without area.
    noise = np.random.default_rng(0).uniform(-0.02, 0.02, vertices.shape)
    return vertices + noise, np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])


def checked(vertices: np.ndarray, faces: np.ndarray) -> ManifoldCheck:
    vertices, faces, _ = compacted(vertices, faces)
    result = validate_manifold(vertices, faces)
    assert result.good, result.defects()
    return result


def block(size: tuple[int, int, int], room: int = 6) -> np.ndarray:
    cells = np.zeros((size[0], size[1], size[2] + room), np.bool_)
    cells[:, :, : size[2]] = True
    return cells


def with_arch(cells: np.ndarray, x: int, y: int, z: int) -> np.ndarray:
    """Two posts of one cube on top of something, and a beam over them."""
    result = cells.copy()
    result[x, y, z] = result[x + 2, y, z] = True
    result[x : x + 3, y, z + 1] = True
    return result


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e4])
def test_a_small_arch_becomes_a_bump(scale: float) -> None:
    vertices, faces = surface_of(with_arch(with_arch(block((16, 16, 4)), 6, 7, 4), 2, 2, 4))
    assert checked(vertices, faces).parts[0].genus == 2
    moved = scale * (vertices + 100.0)
    closed = without_small_handles(moved, faces, scale)
    assert (closed.closed, closed.left) == (2, 0)
    assert [part.genus for part in checked(moved, closed.faces).parts] == [0]
    assert len(closed.faces) < len(faces)
    # Far from the arches nothing has changed.
    far = vertices[faces].max((1, 2)) > 14
    rows = {tuple(face) for face in closed.faces.tolist()}
    assert all(tuple(face) in rows for face in faces[far].tolist())


def test_a_pinhole_through_a_plate_and_an_opening_stay() -> None:
    """Neither lies in a small box: around the hole's other loop the whole plate would have to."""
    plate = np.ones((20, 20, 2), np.bool_)
    plate[4, 4] = False
    plate[10:16, 10:16] = False
    vertices, faces = surface_of(plate)
    assert checked(vertices, faces).parts[0].genus == 2
    closed = without_small_handles(vertices, faces, 1.0)
    assert (closed.closed, closed.left) == (0, 0)
    np.testing.assert_array_equal(closed.faces, faces)


def test_a_ring_of_thin_wire_stays() -> None:
    ring = np.zeros((12, 12, 1), np.bool_)
    ring[0], ring[-1], ring[:, 0], ring[:, -1] = True, True, True, True
    vertices, faces = surface_of(ring)
    closed = without_small_handles(vertices, faces, 1.0)
    assert closed.closed == 0
    assert checked(vertices, closed.faces).parts[0].genus == 1


def test_a_wire_is_not_cut_where_an_arch_stands_on_it() -> None:
    wire = np.zeros((30, 3, 4), np.bool_)
    wire[:, 1, 0] = True
    vertices, faces = surface_of(with_arch(wire, 13, 1, 1))
    closed = without_small_handles(vertices, faces, 1.0)
    assert (closed.closed, closed.left) == (1, 0)
    part = checked(vertices, closed.faces).parts[0]
    assert part.genus == 0
    assert 30.0 < part.volume < 37.0


def test_a_tiny_ring_becomes_a_lump() -> None:
    cells = np.zeros((12, 12, 3), np.bool_)
    cells[4:7, 4:7, 0] = True
    cells[5, 5, 0] = False
    vertices, faces = surface_of(cells)
    closed = without_small_handles(vertices, faces, 1.0)
    assert closed.closed == 1
    assert checked(vertices, closed.faces).parts[0].genus == 0


def test_a_ring_around_a_wire_is_left() -> None:
    """Closing it would cut off a ring that stands out: a thing of its own, not noise."""
    cells = np.zeros((9, 9, 20), np.bool_)
    cells[3:6, 4, :14] = True
    ring = np.zeros((9, 9, 20), np.bool_)
    ring[2:7, 4, 14:19] = True
    ring[3:6, 4, 15:18] = False
    vertices, faces = surface_of(cells | ring)
    closed = without_small_handles(vertices, faces, 1.2)
    assert closed.closed == 0
    assert checked(vertices, closed.faces).parts[0].genus == 1


def test_what_cannot_be_closed_is_left_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = surface_of(with_arch(block((16, 16, 4)), 6, 7, 4))
    monkeypatch.setattr(clean_up, "MAX_LOOP_EDGES", 3)
    closed = without_small_handles(vertices, faces, 1.0)
    assert (closed.closed, closed.left) == (0, 1)
    np.testing.assert_array_equal(closed.faces, faces)


def test_edges_that_the_mesh_has_elsewhere_are_not_used_again() -> None:
    """Many arches side by side share outlines; all that is closed stays a manifold."""
    cells = block((24, 24, 3))
    for x in range(2, 20, 5):
        for y in range(2, 22, 2):
            cells = with_arch(cells, x, y, 3)
    vertices, faces = surface_of(cells)
    before = checked(vertices, faces)
    closed = without_small_handles(vertices, faces, 1.0)
    after = checked(vertices, closed.faces)
    assert before.parts[0].genus == 40
    assert after.parts[0].genus == 40 - closed.closed
    assert closed.closed == 40
