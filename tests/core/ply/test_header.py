# SPDX-License-Identifier: GPL-3.0-or-later
"""PLY headers of splats, clouds and meshes: accepted and refused input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.evaluation.layouts import is_cloud
from gaussian_wrapping_addon.core.ply import MAX_HEADER_BYTES, read_ply_header, read_vertices

HEADER = """ply
format binary_big_endian 1.0
comment two words
obj_info nothing
element vertex 2
property short x
property double y
element face 1
property list uchar int vertex_indices
end_header
"""
BODY = np.array([(1, 2.5), (-3, 4.0)], [("x", ">i2"), ("y", ">f8")]).tobytes() + b"rest"


def written(path: Path, header: str, body: bytes = BODY) -> Path:
    path.write_bytes(header.encode() + body)
    return path


@pytest.mark.parametrize("end", ["\n", "\r\n", " \n", "\t\r\n"])
def test_headers_are_read_whatever_ends_their_lines(end: str, tmp_path: Path) -> None:
    path = written(tmp_path / "a.ply", HEADER.replace("\n", end))
    header = read_ply_header(path, "Again.")
    assert header.encoding == ">"
    assert header.comments == ("two words",)
    assert [(e.name, e.count, e.names) for e in header.elements] == [
        ("vertex", 2, ("x", "y")),
        ("face", 1, ("vertex_indices",)),
    ]
    assert (header.count("vertex"), header.count("face"), header.count("edge")) == (2, 1, 0)
    rows = read_vertices(path, header, "Again.")
    np.testing.assert_array_equal(rows["x"], [1, -3])
    np.testing.assert_array_equal(rows["y"], [2.5, 4.0])
    with pytest.raises(ParseError, match="2 vertices; at most 1"):
        read_vertices(path, header, "Again.", 1)


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("ply\n", "plyx\n", "byte 0"),
        ("ply\n", " ply\n", "byte 0"),
        ("format binary_big_endian 1.0\n", "", "header"),
        ("binary_big_endian", "binary", "line 2"),
        ("end_header", "the end", "header"),
        ("obj_info nothing", "c" * MAX_HEADER_BYTES, "header"),
        ("vertex 2", "vertex two", "line 5"),
        ("vertex 2", "vertex " + 19 * "9", "line 5"),
        ("element vertex 2\n", "", "line 5"),
        ("short x", "half x", "line 6"),
        ("double y", "double x", "line 7"),
        ("list uchar int", "list uchar", "line 9"),
    ],
)
def test_broken_headers_name_their_line(old: str, new: str, place: str, tmp_path: Path) -> None:
    assert old in HEADER
    path = written(tmp_path / "a.ply", HEADER.replace(old, new, 1))
    with pytest.raises(ParseError) as caught:
        read_ply_header(path, "Again.")
    assert (caught.value.location, caught.value.hint) == (place, "Again.")
    with pytest.raises(ParseError):
        is_cloud(path)


def test_a_ply_without_faces_is_a_cloud(tmp_path: Path) -> None:
    assert not is_cloud(written(tmp_path / "a.ply", HEADER))
    assert is_cloud(written(tmp_path / "b.ply", HEADER.replace("face 1", "face 0")))
    assert is_cloud(written(tmp_path / "c.ply", HEADER.replace("element face", "element edge")))
    assert not is_cloud(written(tmp_path / "d.obj", ""))
    with pytest.raises(ParseError, match=r"none\.ply, whole file: cannot be read"):
        is_cloud(tmp_path / "none.ply")
