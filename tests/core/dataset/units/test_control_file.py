# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of control points: systems, lines, and which line is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError, ParseError
from gaussian_wrapping_addon.core.units.control_points import (
    MAX_FILE_BYTES,
    CoordinateSystem,
    parse_control_file,
    read_control_file,
)
from gaussian_wrapping_addon.core.units.georeference import geographic_from_enu, utm_from_geographic

FILE = Path("gcp.txt")
GOOD = """\
# marks on the wall
LOCAL

1.0 2.0 3.0 10.5 20.5 a.jpg corner
1 2 3 30 40 sub/b.jpg corner
4 5 6 1 2 a.jpg
4 5 6 3 4 sub\\b.jpg
"""


def test_points_are_gathered_by_name_or_place() -> None:
    found = parse_control_file(GOOD, FILE)
    assert found.system == CoordinateSystem("local")
    corner, unnamed = found.points
    assert (corner.name, corner.photos, corner.lines) == ("corner", ("a.jpg", "sub/b.jpg"), (4, 5))
    np.testing.assert_array_equal(corner.pixels, [[10.5, 20.5], [30, 40]])
    np.testing.assert_array_equal(corner.position, [1, 2, 3])
    assert (unnamed.name, unnamed.photos) == ("4 5 6", ("a.jpg", "sub/b.jpg"))


def test_tabs_allow_spaces_in_names() -> None:
    (point,) = parse_control_file("local\n1\t2\t3\t4\t5\tmy photo.jpg\tthe corner\n", FILE).points
    assert (point.name, point.photos) == ("the corner", ("my photo.jpg",))


@pytest.mark.parametrize(
    ("head", "wanted"),
    [
        ("EPSG:4326", CoordinateSystem("EPSG:4326")),
        ("epsg: 4979", CoordinateSystem("EPSG:4979")),
        ("+proj=longlat +datum=WGS84 +no_defs", CoordinateSystem("EPSG:4326")),
        ("EPSG:32633", CoordinateSystem("EPSG:32633", 33, True)),
        ("EPSG:32756", CoordinateSystem("EPSG:32756", 56, False)),
        ("WGS84 UTM 17N", CoordinateSystem("EPSG:32617", 17, True)),
        ("+proj=utm +zone=10 +ellps=WGS84 +south", CoordinateSystem("EPSG:32710", 10, False)),
    ],
)
def test_systems(head: str, wanted: CoordinateSystem) -> None:
    assert parse_control_file(f"{head}\n", FILE).system == wanted


def test_geographic_and_utm_become_the_same_metres() -> None:
    places = np.array([[46.8401, -91.99, 200.0], [46.8412, -91.991, 210.0], [46.839, -91.98, 190]])
    by_degrees, origin = CoordinateSystem("EPSG:4326").to_metric(places[:, [1, 0, 2]])
    utm = utm_from_geographic(places, 15, True)
    by_utm, same = CoordinateSystem("EPSG:32615", 15, True).to_metric(utm)
    assert origin is not None
    assert same is not None
    np.testing.assert_allclose(by_utm, by_degrees, atol=1e-6)
    np.testing.assert_allclose(geographic_from_enu(by_utm, same), places, atol=1e-8)
    local, nowhere = CoordinateSystem("local").to_metric(places)
    assert nowhere is None
    assert local is places


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        ("", "whole file", "empty"),
        ("# only a comment\n", "whole file", "empty"),
        ("1 2 3 4 5 a.jpg\n", "line 1", "no known system"),
        ("EPSG:2056\n", "line 1", "EPSG:2056 is not known here"),
        ("EPSG:32661\n", "line 1", "not known"),
        ("+proj=utm +zone=61\n", "line 1", "no known system"),
        ("LOCAL\n1 2 3 4 5\n", "line 2", "5 entries, 6 are needed"),
        ("LOCAL\n\n1 2 x 4 5 a.jpg\n", "line 3", "'x' is not a coordinate"),
        ("LOCAL\n1 2 nan 4 5 a.jpg\n", "line 2", "'nan' is not a coordinate"),
        ("LOCAL\n1 2 1e300 4 5 a.jpg\n", "line 2", "'1e300' is not"),
        ("LOCAL\n1 2 3 4 5 a.jpg p\n1 2 4 4 5 b.jpg p\n", "line 3", "than in line 2"),
        ("LOCAL\n1 2 3 4 5 a.jpg p\n1 2 3 4 6 a.jpg p\n", "line 3", "already, in line 2"),
    ],
)
def test_the_wrong_line_is_named(text: str, where: str, words: str) -> None:
    with pytest.raises(ParseError, match=words) as caught:
        parse_control_file(text, FILE)
    assert caught.value.location == where
    assert "gcp.txt" in caught.value.message


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "gcp.txt"
    with pytest.raises(DatasetError, match="cannot be read"):
        read_control_file(path)
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert len(read_control_file(path).points) == 2
    path.write_bytes(b"LOCAL\n\xff\xfe")
    with pytest.raises(ParseError, match="not UTF-8"):
        read_control_file(path)
    with path.open("wb") as stream:
        stream.truncate(MAX_FILE_BYTES + 1)
    with pytest.raises(DatasetError, match="larger than 16 MiB"):
        read_control_file(path)
