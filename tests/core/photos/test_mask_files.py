# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of other programs: names, inverted, grown and shrunk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.loading.source_kind import source_kind
from gaussian_wrapping_addon.core.photos.finder import find_mask, list_photos
from gaussian_wrapping_addon.core.photos.photo_file import AS_WRITTEN, MaskReading
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.readers.model_writers import ring_model, write_binary, write_photos


def put(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")


def mask_of(source: Path, name: str) -> Path | None:
    kind = source_kind(source)
    return find_mask(kind.mask_roots, name, kind.photo_roots)


@pytest.mark.parametrize(
    "mask",
    ["a.jpg.png", "a.png", "a.jpg", "a_mask.png", "a-mask.png", "a.mask.png", "a.jpg.mask.png"],
)
def test_masks_in_their_folder(tmp_path: Path, mask: str) -> None:
    put(tmp_path / "images" / "a.jpg", tmp_path / "masks" / mask)
    assert mask_of(tmp_path, "a.jpg") == tmp_path / "masks" / mask
    assert mask_of(tmp_path, "b.jpg") is None


@pytest.mark.parametrize(
    "mask",
    ["a_mask.png", "a.jpg.mask.png", "a-mask.jpg", "a.mask.png", "A_MASK.PNG", "a_Mask.tiff"],
)
@pytest.mark.parametrize("folder", ["", "images"])
def test_masks_beside_photos_are_no_photos(tmp_path: Path, mask: str, folder: str) -> None:
    here = tmp_path / folder
    put(here / "a.jpg", here / mask, here / "b.jpg", here / "c.png")
    assert [path.name for path in list_photos(here)] == ["a.jpg", "b.jpg", "c.png"]
    assert mask_of(tmp_path, "a.jpg") == here / mask
    # An unmarked name beside a photo is another photo, not its mask.
    assert mask_of(tmp_path, "b.jpg") is None
    assert mask_of(tmp_path, "c.png") is None


@pytest.mark.parametrize("folder", ["mask", "masks"])
def test_photos_that_masks_are_named_like_stay_photos(tmp_path: Path, folder: str) -> None:
    put(*(tmp_path / folder / f"{k}.jpg" for k in range(3)))
    assert len(list_photos(tmp_path / folder)) == 3
    assert [mask_of(tmp_path / folder, f"{k}.jpg") for k in range(3)] == [None] * 3
    names = ["gas_mask.jpg", "venetian-mask.jpg", "venetian2.jpg"]
    put(*(tmp_path / "things" / name for name in names))
    assert [path.name for path in list_photos(tmp_path / "things")] == names


def test_masks_stay_with_the_photos_of_their_folder(tmp_path: Path) -> None:
    put(tmp_path / "left" / "a.jpg", tmp_path / "right" / "a.jpg", tmp_path / "left/a_mask.png")
    assert len(list_photos(tmp_path)) == 2
    assert mask_of(tmp_path, "left/a.jpg") == tmp_path / "left" / "a_mask.png"
    assert mask_of(tmp_path, "right/a.jpg") is None
    # A link that leads out of the folder is no mask.
    (tmp_path / "right" / "a_mask.png").symlink_to(tmp_path / "left" / "a_mask.png")
    assert mask_of(tmp_path / "right", "a.jpg") is None
    assert mask_of(tmp_path / "right", "a\0.jpg") is None


def square(side: int) -> np.ndarray:
    grey = np.zeros((60, 80), np.uint8)
    grey[30 - side // 2 : 30 + side // 2, 40 - side // 2 : 40 + side // 2] = 255
    return grey


@pytest.mark.parametrize("grow_px", [-7, -1, 0, 5])
def test_growing_moves_the_border_by_as_many_pixels(grow_px: int) -> None:
    kept = MaskReading(grow_px=grow_px).kept(square(20))
    assert kept[30].sum() == kept[:, 40].sum() == 20 + 2 * grow_px
    assert np.array_equal(kept, kept[::-1]) == np.array_equal(kept, kept[:, ::-1])
    # What is kept after inverting grows; whole and empty masks stay.
    inverted = MaskReading(invert=True, grow_px=grow_px).kept(square(20))
    assert (~inverted)[30].sum() == 20 - 2 * grow_px
    for level in (0, 255):
        grey = np.full((5, 6), level, np.uint8)
        assert (MaskReading(grow_px=grow_px).kept(grey) == (level > 0)).all()


def test_loading_reads_masks_so_but_not_alpha(tmp_path: Path) -> None:
    model = ring_model(5)
    write_photos(model, tmp_path / "images")
    write_binary(model, tmp_path / "sparse" / "0")
    names = sorted(path.name for path in (tmp_path / "images").iterdir())
    with Image.open(tmp_path / "images" / names[0]) as photo:
        size = photo.size
        photo.putalpha(Image.new("L", size, 255))
        photo.paste((0, 0, 0, 0), (0, 0, 10, size[1]))
    photo.save(tmp_path / "images" / names[0])
    grey = Image.new("L", size, 255)
    grey.paste(0, (0, 0, 20, size[1]))
    grey.save(tmp_path / "images" / f"{Path(names[1]).stem}_mask.png")

    def shares(reading: MaskReading) -> list[float | None]:
        scene = load_scene(tmp_path, tmp_path / "work", Progress(), reading=reading)
        assert len(scene.views) == 5
        return [
            None
            if view.mask_path is None
            else float(np.mean(np.asarray(Image.open(view.mask_path)) > 0)) * size[0]
            for view in scene.views[:3]
        ]

    whole = size[0]
    assert shares(AS_WRITTEN) == pytest.approx([whole - 10, whole - 20, None])
    assert shares(MaskReading(invert=True)) == pytest.approx([whole - 10, 20, None])
    assert shares(MaskReading(invert=True, grow_px=4)) == pytest.approx([whole - 10, 24, None])
