# SPDX-License-Identifier: GPL-3.0-or-later
"""Renderings of textured meshes agree with an exact ray caster."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.evaluation.mesh_rendering import BACKGROUND, TexturedRenderer
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.evaluation.views.gradient_wall import CAMERAS, gradient_wall, wall_color, wall_hit
from tests.core.texture.texture_scenes import look_at, photograph


def render_textured(textured: TexturedMesh, camera: Camera, size: tuple[int, int]) -> np.ndarray:
    return TexturedRenderer(textured).render(camera, size).image


@pytest.mark.parametrize("index", [0, 1])
def test_rendering_agrees_with_an_exact_picture(index: int) -> None:
    camera = CAMERAS[index]
    truth = photograph([camera], [(wall_hit, wall_color)]).images[0].astype(int)
    got = render_textured(gradient_wall(), camera, (120, 90)).astype(int)
    # Away from the outline, where only the wall (which has no blue) shows in both.
    inside = truth[..., 2] == 0
    assert inside.sum() > 800
    assert (inside != (got[..., 2] == 0)).sum() < 0.03 * inside.sum()
    inside &= got[..., 2] == 0
    assert np.abs(got - truth)[inside].max() <= 4
    outside = (truth == 30).all(axis=2)
    assert (got[outside] == BACKGROUND).mean() > 0.99


def test_size_is_free_and_the_mesh_may_be_out_of_sight() -> None:
    assert render_textured(gradient_wall(), CAMERAS[0], (41, 33)).shape == (33, 41, 3)
    away = look_at((0, -3.0, 0), (0, -6.0, 0))
    assert (render_textured(gradient_wall(), away, (40, 30)) == BACKGROUND).all()


def test_far_textures_are_averaged_not_sampled() -> None:
    """A one-texel checker seen from far must be grey."""
    wall = gradient_wall(256)
    checker = np.indices((256, 256)).sum(axis=0) % 2 * 255
    image = np.repeat(checker[..., None], 3, axis=2).astype(np.uint8)
    far = look_at((0, -20.0, 0), width=60, height=60, focal=200.0)
    got = render_textured(TexturedMesh(wall.mesh, wall.corner_uvs, image), far, (60, 60))
    middle = got[25:35, 25:35].astype(int)
    assert np.abs(middle - 128).max() <= 4


def test_coverage_is_the_share_of_rays_that_meet_the_mesh() -> None:
    wall = TexturedRenderer(gradient_wall())
    view = wall.render(CAMERAS[0])  # the wall spans columns 20 to 100 and rows 5 to 85
    expected = np.zeros((90, 120), np.float32)
    expected[5:85, 20:100] = 1.0
    assert np.array_equal(view.coverage, expected)
    assert np.array_equal(view.covered, expected == 1.0)
    # Four tenths of a pixel to the left: of three rays a row, one enters and one leaves.
    eye = 0.4 * 3.0 / 120.0
    moved = look_at((eye, -3.0, 0.0), (eye, 0, 0), width=120, height=90, focal=120.0)
    expected[5:85, 19], expected[5:85, 99] = np.float32(1 / 3), np.float32(2 / 3)
    view = wall.render(moved)
    assert np.allclose(view.coverage, expected, atol=1e-7)
    assert view.covered.sum() == 80 * 79
    assert (view.image[~view.covered & (expected == 0)] == BACKGROUND).all()
