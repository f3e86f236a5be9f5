# SPDX-License-Identifier: GPL-3.0-or-later
"""A job's mesh beside photos: choice, notes, files, previews, textured renderings."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.evaluation import photo_views
from gaussian_wrapping_addon.core.evaluation.mesh_based_rendering import bake_held_out_texture
from gaussian_wrapping_addon.core.evaluation.mesh_rendering import BACKGROUND, TexturedRenderer
from gaussian_wrapping_addon.core.evaluation.photo_views import (
    GAP_PX,
    MAX_PHOTOS,
    PHOTO_COMPARISON_LONG_SIDE_PX,
    PICTURE_WIDTH_PX,
    choose_view,
    compare_with_photos,
    write_preview,
)
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.evaluation.gradient_wall import CAMERAS, gradient_wall, wall_color, wall_hit
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


def test_a_photo_of_another_exposure_is_also_compared_in_its_own(tmp_path: Path) -> None:
    photos = wall_photos(5)
    plain = compared(photos, {"2.jpg"}, tmp_path, exposed=True)
    photos.images[2] = np.clip(0.7 * photos.images[2] + 12.0, 0, 255).astype(np.uint8)
    dark = compared(photos, {"2.jpg"}, tmp_path, exposed=True)
    assert dark["psnr"] < 25.0 < 35.0 < dark["exposed_psnr"]
    assert dark["exposed_psnr"] == dark["views"][0]["exposed_psnr"]
    assert plain["exposed_psnr"] == pytest.approx(plain["psnr"], abs=1.0)
    assert "exposed_psnr" not in compared(photos, {"2.jpg"}, tmp_path)


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
    assert sorted(p.name for p in tmp_path.iterdir()) == values["pictures"]
    # The texture of the Gaussians holds nothing of the photos: it is judged as it is.
    values = compare_with_photos(
        pink, scene_of(photos), photos, {"2.jpg", "4.jpg"}, tmp_path, Progress(),
        from_gaussians=True,
    )  # fmt: skip
    assert {view["name"]: view["psnr"] for view in values["views"]}["2.jpg"] > 40.0
    assert values["note"] == photo_views.NOTE_GAUSSIANS


@pytest.mark.parametrize(("reduction", "size_px"), [(1, 1024), (3, 512), (99, 256)])
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


def test_the_preview_holds_photo_and_mesh_side_by_side(tmp_path: Path) -> None:
    photos = photograph(CAMERAS, [(wall_hit, wall_color)])
    path = tmp_path / "preview.png"
    write_preview(gradient_wall(), scene_of(photos), photos, path)
    picture = np.asarray(Image.open(path)).astype(int)
    width = (picture.shape[1] - GAP_PX) // 2
    left, right = picture[:, :width], picture[:, width + GAP_PX :]
    inside = (left[..., 2] == 0) & (right[..., 2] == 0)
    assert inside.mean() > 0.3
    assert np.abs(left - right)[inside].max() <= 6
    assert (picture[:, width : width + GAP_PX] == BACKGROUND).all()
    with pytest.raises(ResourceError, match="nowhere"):
        write_preview(gradient_wall(), scene_of(photos), photos, tmp_path / "nowhere" / "p.png")


def test_far_textures_are_averaged_not_sampled() -> None:
    """A one-texel checker seen from far must be grey."""
    wall = gradient_wall(256)
    checker = np.indices((256, 256)).sum(axis=0) % 2 * 255
    image = np.repeat(checker[..., None], 3, axis=2).astype(np.uint8)
    far = look_at((0, -20.0, 0), width=60, height=60, focal=200.0)
    textured = TexturedMesh(wall.mesh, wall.corner_uvs, image)
    got = TexturedRenderer(textured).render(far, (60, 60)).image
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
    assert wall.render(moved, (41, 33)).image.shape == (33, 41, 3)
    view = wall.render(moved)
    assert np.allclose(view.coverage, expected, atol=1e-7)
    assert view.covered.sum() == 80 * 79
    assert (view.image[~view.covered & (expected == 0)] == BACKGROUND).all()
