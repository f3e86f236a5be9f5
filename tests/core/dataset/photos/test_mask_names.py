# SPDX-License-Identifier: GPL-3.0-or-later
"""Names of masks that other programs write, in folders of masks and beside the photos."""

from __future__ import annotations

from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.loading.source_kind import source_kind
from gaussian_wrapping_addon.core.photos.finder import find_mask, list_photos


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
def test_photos_in_a_folder_of_that_name_are_not_their_own_masks(
    tmp_path: Path, folder: str
) -> None:
    put(*(tmp_path / folder / f"{k}.jpg" for k in range(3)))
    assert len(list_photos(tmp_path / folder)) == 3
    assert [mask_of(tmp_path / folder, f"{k}.jpg") for k in range(3)] == [None] * 3


def test_a_photo_of_a_mask_stays_a_photo(tmp_path: Path) -> None:
    put(tmp_path / "gas_mask.jpg", tmp_path / "venetian-mask.jpg", tmp_path / "venetian2.jpg")
    names = [path.name for path in list_photos(tmp_path)]
    assert names == ["gas_mask.jpg", "venetian-mask.jpg", "venetian2.jpg"]


def test_masks_in_subfolders_stay_with_their_photos(tmp_path: Path) -> None:
    put(tmp_path / "left" / "a.jpg", tmp_path / "right" / "a.jpg", tmp_path / "left/a_mask.png")
    assert len(list_photos(tmp_path)) == 2
    assert mask_of(tmp_path, "left/a.jpg") == tmp_path / "left" / "a_mask.png"
    assert mask_of(tmp_path, "right/a.jpg") is None


def test_a_mask_that_leads_out_of_the_folder_is_none(tmp_path: Path) -> None:
    put(tmp_path / "outside.png", tmp_path / "set" / "a.jpg")
    (tmp_path / "set" / "a_mask.png").symlink_to(tmp_path / "outside.png")
    assert mask_of(tmp_path / "set", "a.jpg") is None
    assert mask_of(tmp_path / "set", "a\0.jpg") is None
