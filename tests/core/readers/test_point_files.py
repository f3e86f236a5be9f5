# SPDX-License-Identifier: GPL-3.0-or-later
"""Point clouds in PLY: types, colours, and headers that are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.readers.point_files import read_point_ply

HEADER = "ply\nformat ascii 1.0\ncomment x\nelement vertex 1\n{}end_header\n"


XYZ = "property float x\nproperty float y\nproperty float z\n"


RGB = "property int red\nproperty int green\nproperty int blue\n"


def read(folder: Path, header: str, body: bytes) -> tuple[np.ndarray, np.ndarray]:
    path = folder / "p.ply"
    path.write_bytes(header.encode() + body)
    return read_point_ply(path)


def test_header_lines_may_end_in_blanks_and_a_carriage_return(tmp_path: Path) -> None:
    header = HEADER.format(XYZ + "element face 0\nproperty list uchar int v\n")
    points, colors = read(tmp_path, header.replace("\n", " \r\n"), b"1 2 0.1\r\n")
    np.testing.assert_array_equal(points, [[1, 2, np.float32(0.1)]])  # the declared type decides
    np.testing.assert_array_equal(colors, [[128, 128, 128]])


def test_colours_of_text_are_of_the_declared_type(tmp_path: Path) -> None:
    _, colors = read(tmp_path, HEADER.format(XYZ + RGB), b"1 2 3 10.7 300 nan\n")
    np.testing.assert_array_equal(colors, [[10, 255, 0]])


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("property float x", "property float w", "header"),
        ("comment x", "surprise x", "line 3"),
        ("element vertex 1", "element face 1", "header"),
        ("float z", "float y", "line 7"),
    ],
)
def test_clouds_with_broken_headers_are_refused(
    old: str, new: str, place: str, tmp_path: Path
) -> None:
    with pytest.raises(ParseError) as caught:
        read(tmp_path, HEADER.format(XYZ).replace(old, new), b"1 2 3\n")
    assert caught.value.location == place
