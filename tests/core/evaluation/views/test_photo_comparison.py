# SPDX-License-Identifier: GPL-3.0-or-later
"""Comparison of a job's mesh with photos: choice of photos, notes, files written."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.evaluation import photo_views
from gaussian_wrapping_addon.core.evaluation.mesh_based_rendering import bake_held_out_texture
from gaussian_wrapping_addon.core.evaluation.photo_views import (
    GAP_PX,
    MAX_PHOTOS,
    PHOTO_COMPARISON_LONG_SIDE_PX,
    PICTURE_WIDTH_PX,
    compare_with_photos,
)
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.evaluation.views.gradient_wall import gradient_wall, wall_color, wall_hit
from tests.core.texture.texture_scenes import FakePhotos, look_at, photograph, scene_of


def wall_photos(count: int, width: int = 60, height: int = 45) -> FakePhotos:
    eyes = [(x, -3.0, 0.2) for x in np.linspace(-1, 1, count).tolist()]
    cameras = [
        dataclasses.replace(look_at(eye, width=width, height=height, focal=width), name=f"{i}.jpg")
        for i, eye in enumerate(eyes)
    ]
    return photograph(cameras, [(wall_hit, wall_color)])


def compared(photos: FakePhotos, held_out: Collection[str], folder: Path, **options) -> dict:
    wall = gradient_wall()
    return compare_with_photos(
        wall, scene_of(photos), photos, held_out, folder, Progress(), **options
    )


def names_of(values: dict) -> list[str]:
    return [view["name"] for view in values["views"]]


def test_photos_are_chosen_evenly_and_held_out_ones_first(tmp_path: Path) -> None:
    photos = wall_photos(22)
    values = compared(photos, [], tmp_path)
    assert names_of(values) == [f"{i}.jpg" for i in range(0, 22, 3)]
    assert len(values["views"]) == MAX_PHOTOS
    assert values["held_out"] is False
    assert "all photos, including those compared" in values["note"]
    values = compared(photos, {"3.jpg", "9.jpg"}, tmp_path)
    assert names_of(values) == ["3.jpg", "9.jpg"]
    assert values["held_out"] is True
    assert values["psnr"] > 35.0
    assert json.loads(json.dumps(values, allow_nan=False)) == values


def test_a_held_out_photo_is_judged_by_a_texture_without_it(tmp_path: Path) -> None:
    """The texture of the file is kept out of it, and so is every photo that was held out."""
    photos = wall_photos(5)
    photos.images[2] = np.full_like(photos.images[2], (255, 0, 255))
    photos.images[4] = np.full_like(photos.images[4], (0, 0, 255))
    wall = gradient_wall()
    pink = dataclasses.replace(wall, albedo=np.full_like(wall.albedo, (255, 0, 255)))
    values = compare_with_photos(
        pink, scene_of(photos), photos, {"2.jpg", "4.jpg"}, tmp_path, Progress()
    )
    scores = {view["name"]: view["psnr"] for view in values["views"]}
    assert scores.keys() == {"2.jpg", "4.jpg"}
    assert max(scores.values()) < 12.0
    assert values["note"] == photo_views.NOTE_HELD_OUT
    assert values["texture_size_px"] == len(wall.albedo)
    assert values["bake_s"] >= 0.0
    assert sorted(p.name for p in tmp_path.iterdir()) == values["pictures"]
    # The texture of the Gaussians holds nothing of the photos: it is judged as it is.
    values = compare_with_photos(
        pink, scene_of(photos), photos, {"2.jpg", "4.jpg"}, tmp_path, Progress(),
        from_gaussians=True,
    )  # fmt: skip
    assert {view["name"]: view["psnr"] for view in values["views"]}["2.jpg"] > 40.0
    assert values["note"] == photo_views.NOTE_GAUSSIANS


@pytest.mark.parametrize(("reduction", "size_px"), [(1, 1024), (3, 512), (4, 256), (99, 256)])
def test_the_texture_without_them_is_as_coarse_as_the_pictures(
    tmp_path: Path, reduction: int, size_px: int
) -> None:
    photos = wall_photos(3)
    textured = bake_held_out_texture(
        gradient_wall(1024), scene_of(photos), photos, {"1.jpg"}, reduction, tmp_path, Progress(),
        threads=1,
    )  # fmt: skip
    assert textured.albedo.shape == (size_px, size_px, 3)
    assert (textured.corner_uvs == gradient_wall().corner_uvs).all()
    assert textured.statistics["photos_used"] == 2
    assert textured.statistics["charts"] == 1


def test_comparisons_are_written_and_named(tmp_path: Path) -> None:
    photos = wall_photos(5)
    values = compared(photos, [], tmp_path)
    assert values["pictures"] == [f"comparison-{k}.jpg" for k in (1, 2, 3)]
    assert sorted(p.name for p in tmp_path.iterdir()) == values["pictures"]
    assert [v.get("picture") for v in values["views"]] == [
        "comparison-1.jpg", None, "comparison-2.jpg", None, "comparison-3.jpg",
    ]  # fmt: skip
    with Image.open(tmp_path / "comparison-2.jpg") as picture:
        assert (picture.format, picture.size) == ("JPEG", (120 + GAP_PX, 45))
        left = np.asarray(picture)[:, :60].astype(int)
    assert np.abs(left - photos.images[2]).mean() < 6.0


def test_large_photos_are_compared_small(tmp_path: Path) -> None:
    photos = wall_photos(1, 1700, 120)
    values = compared(photos, [], tmp_path)
    with Image.open(tmp_path / values["pictures"][0]) as picture:
        # 1700 / 3 is the largest whole fraction that fits.
        assert PHOTO_COMPARISON_LONG_SIDE_PX >= 1700 // 3
        assert picture.size == (2 * (1700 // 3) + GAP_PX, 40)
    photos = wall_photos(1, 800, 40)
    values = compared(photos, [], tmp_path)
    with Image.open(tmp_path / values["pictures"][0]) as picture:
        assert picture.size == (PICTURE_WIDTH_PX, round(40 * PICTURE_WIDTH_PX / (1600 + GAP_PX)))


def test_what_a_photo_masks_out_does_not_count(tmp_path: Path) -> None:
    photos = wall_photos(1)
    photos.images[0] = photos.images[0].copy()
    photos.images[0][:, :30] = 255
    mask = np.zeros((45, 60), bool)
    mask[:, 32:] = True
    spoilt = compared(photos, [], tmp_path)
    assert spoilt["psnr"] < 15.0
    photos.masks = [mask]
    values = compared(photos, [], tmp_path)
    assert values["psnr"] > 35.0


def test_a_mesh_that_no_photo_shows_has_no_figures(tmp_path: Path) -> None:
    photos = wall_photos(2)
    wall = gradient_wall()
    far = dataclasses.replace(wall.mesh, vertices=wall.mesh.vertices - np.array([0.0, 50.0, 0.0]))
    behind = dataclasses.replace(wall, mesh=far)
    values = compare_with_photos(behind, scene_of(photos), photos, [], tmp_path, Progress())
    assert (values["views"], values["pictures"], values["left_out"]) == ([], [], 2)
    assert list(tmp_path.iterdir()) == []
