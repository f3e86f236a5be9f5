# SPDX-License-Identifier: GPL-3.0-or-later
"""A job's mesh beside the job's photos: which photos, what is told, what is written."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.evaluation.views import lpips, photo_comparison
from gaussian_wrapping_addon.core.evaluation.views.photo_comparison import (
    LONG_SIDE_PX,
    MAX_PHOTOS,
    PICTURE_WIDTH_PX,
    compare_with_photos,
)
from gaussian_wrapping_addon.core.evaluation.views.side_by_side import GAP_PX
from tests.core.evaluation.views.gradient_wall import gradient_wall, wall_color, wall_hit
from tests.core.texture.texture_scenes import FakePhotos, look_at, photograph, scene_of


def wall_photos(count: int, width: int = 60, height: int = 45) -> FakePhotos:
    eyes = [(x, -3.0, 0.2) for x in np.linspace(-1, 1, count).tolist()]
    cameras = [
        dataclasses.replace(look_at(eye, width=width, height=height, focal=width), name=f"{i}.jpg")
        for i, eye in enumerate(eyes)
    ]
    return photograph(cameras, [(wall_hit, wall_color)])


def names_of(values: dict) -> list[str]:
    return [view["name"] for view in values["views"]]


def test_photos_are_chosen_evenly_and_held_out_ones_first(tmp_path: Path) -> None:
    photos = wall_photos(22)
    scene = scene_of(photos)
    values = compare_with_photos(gradient_wall(), scene, photos, [], tmp_path)
    assert names_of(values) == [f"{i}.jpg" for i in range(0, 22, 3)]
    assert len(values["views"]) == MAX_PHOTOS
    assert values["held_out"] is False
    values = compare_with_photos(gradient_wall(), scene, photos, {"3.jpg", "9.jpg"}, tmp_path)
    assert names_of(values) == ["3.jpg", "9.jpg"]
    assert values["held_out"] is True
    assert "all photos" in values["note"]
    assert values["psnr"] > 35.0
    assert json.loads(json.dumps(values, allow_nan=False)) == values


def test_comparisons_are_written_and_named(tmp_path: Path) -> None:
    photos = wall_photos(5)
    values = compare_with_photos(gradient_wall(), scene_of(photos), photos, [], tmp_path)
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
    values = compare_with_photos(gradient_wall(), scene_of(photos), photos, [], tmp_path)
    with Image.open(tmp_path / values["pictures"][0]) as picture:
        # 1700 / 3 is the largest whole fraction that fits.
        assert LONG_SIDE_PX >= 1700 // 3
        assert picture.size == (2 * (1700 // 3) + GAP_PX, 40)
    photos = wall_photos(1, 800, 40)
    values = compare_with_photos(gradient_wall(), scene_of(photos), photos, [], tmp_path)
    with Image.open(tmp_path / values["pictures"][0]) as picture:
        assert picture.size == (PICTURE_WIDTH_PX, round(40 * PICTURE_WIDTH_PX / (1600 + GAP_PX)))


def test_what_a_photo_masks_out_does_not_count(tmp_path: Path) -> None:
    photos = wall_photos(1)
    photos.images[0] = photos.images[0].copy()
    photos.images[0][:, :30] = 255
    mask = np.zeros((45, 60), bool)
    mask[:, 32:] = True
    spoilt = compare_with_photos(gradient_wall(), scene_of(photos), photos, [], tmp_path)
    assert spoilt["psnr"] < 15.0
    photos.masks = [mask]
    values = compare_with_photos(gradient_wall(), scene_of(photos), photos, [], tmp_path)
    assert values["psnr"] > 35.0


def test_a_mesh_that_no_photo_shows_has_no_figures(tmp_path: Path) -> None:
    photos = wall_photos(2)
    wall = gradient_wall()
    far = dataclasses.replace(wall.mesh, vertices=wall.mesh.vertices - np.array([0.0, 50.0, 0.0]))
    behind = dataclasses.replace(wall, mesh=far)
    values = compare_with_photos(behind, scene_of(photos), photos, [], tmp_path)
    assert (values["views"], values["pictures"], values["left_out"]) == ([], [], 2)
    assert list(tmp_path.iterdir()) == []


def test_broken_weights_of_lpips_do_not_end_the_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> None:
        raise ParseError("alex.pth", "whole file", "not weights.")

    monkeypatch.setattr(lpips.Lpips, "load", broken)
    assert photo_comparison.lpips_if_ready is lpips.lpips_if_ready
    photos = wall_photos(1)
    values = compare_with_photos(gradient_wall(), scene_of(photos), photos, [], tmp_path)
    assert "alex.pth" in values["lpips_note"]
    assert "lpips" not in values
