# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks in the panel: made of a region, shown over their photos, accepted and rejected."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.masks.mask_folder import MadeMask, MaskList, read_list, write_list
from gaussian_wrapping_addon.ops import addon, masks
from gaussian_wrapping_addon.ops import addon as known_jobs
from gaussian_wrapping_addon.ui import region_panel
from tests.blender.fake_layout import draw
from tests.blender.job_play import start_wrap, wait_for

NAMES = ("a.png", "b.png", "c.png")
WIDTH, HEIGHT = 40, 30


@pytest.fixture
def masked(tmp_path: Path, addon: object) -> Path:
    """A job folder with three grey photos, masked to their left halves."""
    folder = tmp_path / "job"
    (folder / "masks").mkdir(parents=True)
    (folder / "photos").mkdir()
    for shade, name in zip((60, 120, 240), NAMES, strict=True):
        Image.new("RGB", (WIDTH, HEIGHT), (shade, 0, 0)).save(folder / "photos" / name)
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:, : WIDTH // 2] = 255
        mask[0] = 255  # the upper row, to tell up from down
        Image.fromarray(mask).save(folder / "masks" / f"{name}.png")
    entries = tuple(MadeMask(name, f"{name}.png", f"photos/{name}") for name in NAMES)
    write_list(folder / "masks", MaskList("ab12", entries))
    bpy.context.scene.gwrap.job_folder = str(folder)
    known_jobs.remember(folder)
    return folder


def picture() -> np.ndarray:
    """Return the picture under review, (h, w, 4), from the top down."""
    image = bpy.data.images[masks.IMAGE_NAME]
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1]


def rejected(folder: Path) -> set[str]:
    found = read_list(folder / "masks")
    assert found is not None
    return set(found.rejected)


def test_photos_are_shown_under_their_masks(masked: Path) -> None:
    before = set(bpy.data.images.keys())
    assert bpy.ops.gwrap.review_masks() == {"FINISHED"}
    shown = picture()
    assert shown.shape == (HEIGHT, WIDTH, 4)
    red = 60 / 255
    np.testing.assert_allclose(shown[1:, : WIDTH // 2, 0], red, atol=0.01)
    np.testing.assert_allclose(shown[0, :, 0], red, atol=0.01)
    np.testing.assert_allclose(
        shown[1:, WIDTH // 2 :, 0], masks.DIMMED * red + masks.LEFT_OUT[0], atol=0.01
    )
    np.testing.assert_allclose(shown[1:, WIDTH // 2 :, 2], masks.LEFT_OUT[2], atol=0.01)
    assert set(bpy.data.images.keys()) - before == {masks.IMAGE_NAME}
    assert bpy.ops.gwrap.step_mask() == {"FINISHED"}
    np.testing.assert_allclose(picture()[1:, : WIDTH // 2, 0], 120 / 255, atol=0.01)
    bpy.ops.gwrap.step_mask(by=-1)
    bpy.ops.gwrap.step_mask(by=-1)
    np.testing.assert_allclose(picture()[1:, : WIDTH // 2, 0], 240 / 255, atol=0.01)
    bpy.ops.gwrap.end_mask_review()
    assert set(bpy.data.images.keys()) == before
    assert not bpy.ops.gwrap.step_mask.poll()


def test_decisions_are_written_at_once_and_can_be_taken_back(masked: Path) -> None:
    bpy.ops.gwrap.review_masks()
    bpy.ops.gwrap.decide_mask(accepted=False)
    assert rejected(masked) == {"a.png"}
    bpy.ops.gwrap.decide_mask(accepted=True)
    bpy.ops.gwrap.decide_mask(accepted=False)
    assert rejected(masked) == {"a.png", "c.png"}
    assert masks.shown()[0].photo == "a.png"  # after the last comes the first
    assert masks.place() == (1, 3, 2)
    words = draw(region_panel.GWRAP_PT_region).texts
    assert "a.png" in words
    assert "1 of 3, 2 rejected" in words
    bpy.ops.gwrap.decide_mask(accepted=True)
    assert rejected(masked) == {"c.png"}


def test_other_masks_that_were_made_meanwhile_are_not_decided_on(masked: Path) -> None:
    bpy.ops.gwrap.review_masks()
    found = read_list(masked / "masks")
    assert found is not None
    write_list(masked / "masks", MaskList("cd34", found.masks))
    with pytest.raises(RuntimeError, match="Other masks were made meanwhile"):
        bpy.ops.gwrap.decide_mask(accepted=False)
    assert rejected(masked) == set()
    assert not masks.is_open()


def test_a_deleted_mask_is_shown_as_left_out(masked: Path) -> None:
    (masked / "masks" / "a.png.png").unlink()
    bpy.ops.gwrap.review_masks()
    np.testing.assert_allclose(picture()[..., 2], masks.LEFT_OUT[2], atol=0.01)


@pytest.mark.parametrize("damage", ["no list", "bad list", "no photo", "bad mask"])
def test_what_cannot_be_shown_is_told(masked: Path, damage: str) -> None:
    images = len(bpy.data.images)
    if damage == "no list":
        (masked / "masks" / "masks.json").unlink()
    elif damage == "bad list":
        (masked / "masks" / "masks.json").write_text("{}")
    elif damage == "no photo":
        (masked / "photos" / "a.png").unlink()
    else:
        (masked / "masks" / "a.png.png").write_bytes(b"no image")
    words = {"no list": "made no masks", "bad list": "version 1"}.get(damage, "cannot be read")
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.gwrap.review_masks()
    assert len(bpy.data.images) == images


@pytest.mark.usefixtures("ended_workers")
def test_masks_from_a_region_train_the_same_photos_again(photos: Path, worker: object) -> None:
    start_wrap(photos)
    wait_for("DONE")
    folder = Path(bpy.context.scene.gwrap.job_folder)
    (region,) = addon.objects_of_kind(bpy.context.scene, "region")
    region.select_set(True)
    bpy.context.view_layer.objects.active = region
    assert bpy.ops.gwrap.masks_from_region() == {"FINISHED"}
    job = read_job(folder / "job.json")
    assert (job.command, job.source) == ("wrap", str(photos))
    assert job.settings.make_masks == "region"
    assert len(job.region_bodies) == 1
    assert job.settings.mask_regions
    assert Path(bpy.context.scene.gwrap.job_folder) == folder
    wait_for("DONE")
