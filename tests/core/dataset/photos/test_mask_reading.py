# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks inverted, grown and shrunk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.photos.photo_file import AS_WRITTEN, MaskReading
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.dataset.model_writers import ring_model, write_binary, write_photos


def square(side: int) -> np.ndarray:
    grey = np.zeros((60, 80), np.uint8)
    grey[30 - side // 2 : 30 + side // 2, 40 - side // 2 : 40 + side // 2] = 255
    return grey


def test_as_written() -> None:
    assert np.array_equal(AS_WRITTEN.kept(square(20)), square(20) > 0)
    assert np.array_equal(MaskReading(invert=True).kept(square(20)), square(20) == 0)


@pytest.mark.parametrize("grow_px", [-7, -1, 1, 5])
def test_growing_moves_the_border_by_as_many_pixels(grow_px: int) -> None:
    kept = MaskReading(grow_px=grow_px).kept(square(20))
    assert kept[30].sum() == kept[:, 40].sum() == 20 + 2 * grow_px
    assert np.array_equal(kept, kept[::-1]) == np.array_equal(kept, kept[:, ::-1])


def test_growing_is_of_what_is_kept_after_inverting() -> None:
    kept = MaskReading(invert=True, grow_px=3).kept(square(20))
    assert (~kept)[30].sum() == 14


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize("grow_px", [-3, 3])
def test_whole_and_empty_masks_stay(level: int, grow_px: int) -> None:
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
