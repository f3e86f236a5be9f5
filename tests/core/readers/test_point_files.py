# SPDX-License-Identifier: GPL-3.0-or-later
"""Point clouds in PLY: types, colours, and headers that are refused."""

from __future__ import annotations

import struct
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


def test_text_is_of_the_declared_types(tmp_path: Path) -> None:
    _, colors = read(tmp_path, HEADER.format(XYZ + RGB), b"1 2 3 10.7 300 nan\n")
    np.testing.assert_array_equal(colors, [[10, 255, 0]])
    # Lines of the header may end in blanks and a carriage return.
    header = HEADER.format(XYZ + "element face 0\nproperty list uchar int v\n")
    points, colors = read(tmp_path, header.replace("\n", " \r\n"), b"1 2 0.1\r\n")
    np.testing.assert_array_equal(points, [[1, 2, np.float32(0.1)]])
    np.testing.assert_array_equal(colors, [[128, 128, 128]])


def test_points_of_every_encoding(tmp_path: Path) -> None:
    rows = [(1.0, 2.0, 3.0, 10, 20, 30), (4.0, 5.0, 6.5, 255, 0, 7)]
    bodies = {
        "ascii": "\n".join(" ".join(map(str, row)) for row in rows).encode(),
        "binary_little_endian": b"".join(struct.pack("<3f3B", *row) for row in rows),
        "binary_big_endian": b"".join(struct.pack(">3f3B", *row) for row in rows),
    }
    for encoding, body in bodies.items():
        header = HEADER.format(XYZ + RGB.replace("int", "uchar")).replace("ascii", encoding)
        points, colors = read(tmp_path, header.replace("vertex 1", "vertex 2"), body)
        np.testing.assert_array_equal(points, [[1, 2, 3], [4, 5, 6.5]])
        np.testing.assert_array_equal(colors, [[10, 20, 30], [255, 0, 7]])
        for count in (3, 2**31 - 1, 10**30):  # bounded by the file
            with pytest.raises(ParseError, match=r"p\.ply"):
                read(tmp_path, header.replace("vertex 1", f"vertex {count}"), body)


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
