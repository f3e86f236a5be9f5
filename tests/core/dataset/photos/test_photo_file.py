# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos are closed once they are read, or were found to be unreadable."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.photos.photo_file import read_mask, read_photo

PIXELS = np.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=np.uint8)


def open_files(folder: Path) -> list[str]:
    """Return the files of a folder that this process holds open."""
    names = []
    for entry in Path("/proc/self/fd").iterdir():
        try:
            names.append(os.readlink(entry))
        except OSError:  # the listing's own
            continue
    return [name for name in names if name.startswith(str(folder))]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc, which Linux has")
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp", "bmp"])
@pytest.mark.parametrize("read", [read_photo, read_mask])
def test_no_file_stays_open(tmp_path: Path, suffix: str, read: object) -> None:
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(PIXELS).save(path)
    kept = read(path)  # type: ignore[operator]
    assert open_files(tmp_path) == []
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DatasetError) as caught:
        read(path)  # type: ignore[operator]
    # The traceback, which the exception holds, holds what was opened.
    assert open_files(tmp_path) == []
    assert "a." in str(caught.value)
    assert kept is not None


def test_pixels_outlive_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(PIXELS).save(path)
    np.testing.assert_array_equal(read_photo(path).color, PIXELS)
