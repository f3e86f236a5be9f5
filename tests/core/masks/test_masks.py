# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks made from shares, and their folder, which is never overwritten."""

from __future__ import annotations

import io
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.masks.mask_folder import (
    LIST_NAME,
    MadeMask,
    MaskList,
    digest,
    mask_names,
    publish,
    read_list,
    used_masks,
    write_list,
)
from gaussian_wrapping_addon.core.masks.segmentation import GROWN_SHARE, cleaned, encoded


def disc(size: int, radius: float, at: tuple[float, float] | None = None) -> np.ndarray:
    y, x = np.mgrid[:size, :size]
    cx, cy = at or (size / 2, size / 2)
    return (x - cx) ** 2 + (y - cy) ** 2 <= radius**2


def test_floaters_go_large_holes_stay_and_thin_spots_close() -> None:
    object_, hole, spot = disc(200, 60), disc(200, 15), disc(200, 1, (130, 100))
    share = np.where(object_ | disc(200, 4, (20, 20)), 0.9, 0.2).astype(np.float32)
    assert (cleaned(share, (200, 200)) == object_).all()
    share = np.where(object_ & ~hole & ~spot, 1.0, 0.0).astype(np.float32)
    mask = cleaned(share, (200, 200))
    assert (mask == (object_ & ~hole)).all()
    empty = np.zeros((30, 40), np.float32)
    assert not cleaned(empty, (80, 60), GROWN_SHARE).any()
    assert cleaned(empty + 1, (80, 60), GROWN_SHARE).all()
    with Image.open(io.BytesIO(encoded(mask))) as image:
        assert image.format == "PNG"
        assert (np.asarray(image) == np.where(mask, 255, 0)).all()


def test_a_hole_that_is_half_full_closes() -> None:
    full = disc(200, 60)
    for filled, stays in ((0.1, True), (0.29, True), (0.31, False), (0.45, False)):
        hole = disc(200, 15)
        share = np.where(hole, filled, np.where(full, 1.0, 0.0)).astype(np.float32)
        assert (cleaned(share, (200, 200)) == (full & ~hole if stays else full)).all()


def test_the_border_grows_by_the_share_of_the_long_side() -> None:
    share = disc(400, 90).astype(np.float32)
    radius = round(GROWN_SHARE * 2000)
    exact = cleaned(share, (2000, 2000))
    grown = cleaned(share, (2000, 2000), GROWN_SHARE)
    distance = ndimage.distance_transform_edt(~exact)
    assert (grown == (distance <= radius)).all()


PHOTOS = ("a.jpg", "left/b.jpg", "left/c.png")


def make(root: Path, key: str) -> tuple[Path, MaskList]:
    """Return the folder of a stage with three files, and its list."""
    made = root / f"stage-{key}"
    made.mkdir()
    for index in range(len(PHOTOS)):
        (made / f"{index:06d}.png").write_bytes(f"{key} {index}".encode())
    entries = zip(PHOTOS, mask_names(PHOTOS), strict=True)
    return made, MaskList(key, tuple(MadeMask(p, f, f"photos/{p}") for p, f in entries))


def test_masks_are_published_once_and_edits_stay(tmp_path: Path) -> None:
    made, masks = make(tmp_path, "aa")
    folder = publish(tmp_path, made, masks)
    assert read_list(folder) == masks
    assert (folder / "left/b.jpg.png").read_bytes() == b"aa 1"
    before = digest(folder, masks)
    (folder / "left/b.jpg.png").write_bytes(b"edited")
    assert publish(tmp_path, made, masks) == folder
    assert (folder / "left/b.jpg.png").read_bytes() == b"edited"
    assert digest(folder, masks) != before


def test_other_masks_take_the_place_and_the_first_come_back(tmp_path: Path) -> None:
    made, masks = make(tmp_path, "aa")
    folder = publish(tmp_path, made, masks)
    (folder / "a.jpg.png").write_bytes(b"edited")
    write_list(folder, masks.with_decision("left/c.png", accepted=False))
    before = digest(folder, masks.with_decision("left/c.png", accepted=False))
    publish(tmp_path, *make(tmp_path, "bb"))
    assert (folder / "a.jpg.png").read_bytes() == b"bb 0"
    assert (tmp_path / "masks-aa" / "a.jpg.png").read_bytes() == b"edited"
    assert publish(tmp_path, made, masks) == folder
    back = read_list(folder)
    assert back.rejected == {"left/c.png"}
    assert digest(folder, back) == before
    assert (tmp_path / "masks-bb" / "a.jpg.png").read_bytes() == b"bb 0"


def test_files_without_a_list_are_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for number, aside in ((1, "masks-kept"), (2, "masks-kept-2")):
        (tmp_path / "masks").mkdir()
        (tmp_path / "masks" / "a.jpg.png").write_bytes(f"mine {number}".encode())
        folder = publish(tmp_path, *make(tmp_path, f"a{number}"))
        assert (folder / "a.jpg.png").read_bytes() == f"a{number} 0".encode()
        assert (tmp_path / aside / "a.jpg.png").read_bytes() == f"mine {number}".encode()
        assert f"they are in {aside} now" in caplog.text
        shutil.rmtree(folder)


def test_what_an_interrupted_run_has_left_is_made_again(tmp_path: Path) -> None:
    made, masks = make(tmp_path, "aa")
    (tmp_path / "masks-aa").mkdir()
    (tmp_path / "masks-aa" / "a.jpg.png").write_bytes(b"half")
    folder = publish(tmp_path, made, masks)
    assert (folder / "a.jpg.png").read_bytes() == b"aa 0"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["masks", "stage-aa"]


def test_rejecting_and_deleting_mean_the_same_and_links_are_refused(tmp_path: Path) -> None:
    assert read_list(tmp_path) is None
    made, masks = make(tmp_path, "aa")
    folder = publish(tmp_path, made, masks)
    rejected = masks.with_decision("a.jpg", accepted=False)
    by_list = digest(folder, rejected)
    assert by_list != digest(folder, masks)
    assert [mask.photo for mask, _ in used_masks(folder, rejected)] == list(PHOTOS[1:])
    (folder / "a.jpg.png").unlink()
    assert digest(folder, masks) == by_list
    assert rejected.with_decision("a.jpg", accepted=True) == masks
    (folder / "a.jpg.png").symlink_to(folder / "left/b.jpg.png")
    with pytest.raises(ParseError, match="a link"):
        digest(folder, masks)


def test_the_digest_knows_no_dates_and_no_folders(tmp_path: Path) -> None:
    digests = set()
    for time_s in (1, 2):
        root = tmp_path / str(time_s)
        root.mkdir()
        folder = publish(root, *make(root, "aa"))
        os.utime(folder / "a.jpg.png", (time_s, time_s))
        digests.add(digest(folder, read_list(folder)))
    assert len(digests) == 1


def test_names_are_safe_and_distinct() -> None:
    photos = ["a.jpg", "A.jpg", "../b.jpg", "/c.jpg", "d\\e.jpg", "con.jpg", "f.jpg.png/g.jpg",
              "f.jpg", "n" * 2000, "masks.json"]  # fmt: skip
    names = mask_names(photos)
    assert names[0] == "a.jpg.png"
    assert names[1:4] == ["000001.png", "000002.png", "000003.png"]
    assert names[4] == "d/e.jpg.png"
    assert len({name.casefold() for name in names}) == len(names)
    above = {parent.as_posix() for name in names for parent in Path(name).parents}
    assert not above & set(names)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version 1 was expected"),
        ({"masks": {}}, "not a list of masks"),
        ({"masks": [{"photo": "a.jpg"}]}, r"masks\[0\]: not photo, file and image"),
        (
            {"masks": [{"photo": "a.jpg", "file": "../../x.png", "image": ""}]},
            "is no file of this folder",
        ),
        ({"rejected": "a.jpg"}, "rejected: not a list"),
        ({"rejected": ["z.jpg"]}, "there is no photo 'z.jpg'"),
        ({"made_by": "../aa"}, "not the key of a stage"),
        ({"made_by": 3}, "not the key of a stage"),
    ],
)
def test_damaged_lists_are_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    folder = publish(tmp_path, *make(tmp_path, "aa"))
    write_json(folder / LIST_NAME, {**read_json(folder / LIST_NAME), **change})
    with pytest.raises(ParseError, match=words) as caught:
        read_list(folder)
    assert caught.value.hint
