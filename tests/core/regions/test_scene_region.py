# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions on the grid of the scene: plane faces stay plane, and the world's place is forgotten."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.regions.scene_regions import on_scene_grid, region_in_scene
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Similarity, rotation_from_quaternion

TURN = rotation_from_quaternion(np.array([0.3, -0.8, 0.5, 0.2]))
assert TURN is not None
SIX = np.stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], 1)
LID = np.concatenate([SIX, np.ones((6, 1))], 1)
FLOOR = LID * [1.0, 1.0, -1.0]
BOX = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-0.01, 1)], float)
TAPER = BOX * np.where(BOX[:, 2:] > 0.5, [0.37, 0.37, 1.0], 1.0)
BODIES = {
    "box": (1.3 * BOX @ TURN.T, 6),
    "slab": (BOX * [1, 1, 1e-3] @ TURN.T, 6),
    "small box": (1e-3 * BOX @ TURN.T + 2.0, 6),
    "prism": (np.concatenate([LID, FLOOR]) @ TURN.T, 8),
    "frustum": (TAPER @ TURN.T, 6),
    "corners of no pattern": (np.random.default_rng(2).normal(size=(12, 3)), None),
}


@pytest.mark.parametrize("name", BODIES)
def test_faces_stay_and_corners_hardly_move(name: str) -> None:
    vertices, faces = BODIES[name]
    body = Region(name, vertices)
    near = on_scene_grid(body)
    assert not np.array_equal(near.vertices, body.vertices), "it was rounded"
    assert len(near.half_spaces[1]) == len(body.half_spaces[1])
    if faces is not None:
        assert len(near.half_spaces[1]) == faces
    limit = min(1e-5, 4e-6 * body.diagonal)
    np.testing.assert_allclose(near.vertices, body.vertices, rtol=0, atol=limit)
    np.testing.assert_array_equal(on_scene_grid(near).vertices, near.vertices)


@pytest.mark.parametrize("name", ["box", "slab", "prism", "frustum", "corners of no pattern"])
@pytest.mark.parametrize(
    ("scale", "offset"),
    [(1e-3, (0, 0, 0)), (1e4, (0, 0, 0)), (1.0, (5e5, 5e5, 5e5)), (0.6, (5e5, 4e6, 0))],
)
def test_the_same_bits_wherever_the_world_is(
    name: str, scale: float, offset: tuple[float, float, float]
) -> None:
    body = on_scene_grid(Region(name, BODIES[name][0]))
    world_from_scene = Similarity(scale, TURN.T, np.array(offset, float))
    world = body.transformed(world_from_scene)
    np.testing.assert_array_equal(region_in_scene(world, world_from_scene).vertices, body.vertices)


def test_a_body_whose_faces_would_break_is_left_as_it_is() -> None:
    """The faces of a dodecahedron have five corners without any affine pattern of round numbers."""
    golden = (1 + 5**0.5) / 2
    corners = [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    for a in (-1 / golden, 1 / golden):
        for b in (-golden, golden):
            corners += [[0, a, b], [a, b, 0], [b, 0, a]]
    body = Region("twelve", np.array(corners, float) @ TURN.T)
    assert len(body.half_spaces[1]) == 12
    assert on_scene_grid(body) is body
