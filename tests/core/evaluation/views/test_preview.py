# SPDX-License-Identifier: GPL-3.0-or-later
"""Preview picture: choice of the photo, and the mesh rendered from its camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.evaluation.mesh_rendering import BACKGROUND
from gaussian_wrapping_addon.core.evaluation.photo_views import GAP_PX, choose_view, write_preview
from tests.core.evaluation.views.gradient_wall import CAMERAS, gradient_wall, wall_color, wall_hit
from tests.core.texture.texture_scenes import FakePhotos, look_at, photograph, scene_of


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
