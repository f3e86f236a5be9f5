# SPDX-License-Identifier: GPL-3.0-or-later
"""The preview: what is rendered is what an exact ray caster sees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.evaluation.preview import (
    BACKGROUND,
    GAP_PX,
    choose_view,
    render_textured,
    write_preview,
)
from gaussian_wrapping_addon.core.meshing.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.texture.textured_mesh import TexturedMesh
from tests.core.texture.texture_scenes import FakePhotos, look_at, photograph, scene_of


def gradient_wall(size_px: int = 64) -> TexturedMesh:
    """A square from (-1, 0, -1) to (1, 0, 1), red to the right, green upwards, facing -y."""
    vertices = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    ramp = (np.arange(size_px) + 0.5) / size_px * 255
    image = np.zeros((size_px, size_px, 3))
    image[..., 0] = ramp[None, :]
    image[..., 1] = ramp[::-1, None]
    return TexturedMesh(SurfaceMesh(vertices, faces), uv[faces], np.rint(image).astype(np.uint8))


def wall_hit(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origin[1] / rays[..., 1]
        points = origin + rays * t[..., None]
    inside = (t > 0) & (np.abs(points[..., [0, 2]]) <= 1).all(axis=-1)
    return np.where(inside, t, np.inf)


def wall_color(points: np.ndarray) -> np.ndarray:
    out = np.zeros(points.shape)
    out[..., 0] = (points[..., 0] + 1) / 2 * 255
    out[..., 1] = (points[..., 2] + 1) / 2 * 255
    return out


CAMERAS = [
    look_at((0.0, -3.0, 0.0), (0, 0, 0), width=120, height=90, focal=120.0),
    look_at((1.5, -2.5, 1.0), (0, 0, 0), width=120, height=90, focal=120.0),
]


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


def test_the_view_that_shows_the_front_large_and_whole_is_chosen() -> None:
    cameras = [
        look_at((0, -12.0, 0)),  # small
        look_at((0, -0.7, 0)),  # cut off
        look_at((0, -3.0, 0)),
        look_at((0, 3.0, 0)),  # from behind
        look_at((0, -3.0, 0), (0, -9, 0)),  # not seen
    ]
    photos = FakePhotos(cameras, [])
    assert choose_view(gradient_wall(), photos, len(cameras)) == 2


def test_the_file_holds_photo_and_mesh_side_by_side(tmp_path: Path) -> None:
    photos = photograph(CAMERAS, [(wall_hit, wall_color)])
    path = tmp_path / "preview.png"
    write_preview(gradient_wall(), scene_of(photos), photos, path, view=0)
    picture = np.asarray(Image.open(path)).astype(int)
    width = (picture.shape[1] - GAP_PX) // 2
    left, right = picture[:, :width], picture[:, width + GAP_PX :]
    assert left.shape == right.shape
    inside = (left[..., 2] == 0) & (right[..., 2] == 0)
    assert inside.mean() > 0.3
    assert np.abs(left - right)[inside].max() <= 6
    assert (picture[:, width : width + GAP_PX] == BACKGROUND).all()


def test_a_folder_that_is_missing_is_named(tmp_path: Path) -> None:
    photos = photograph(CAMERAS[:1], [(wall_hit, wall_color)])
    with pytest.raises(ResourceError, match="nowhere"):
        write_preview(gradient_wall(), scene_of(photos), photos, tmp_path / "nowhere" / "p.png")
