# SPDX-License-Identifier: GPL-3.0-or-later
"""GPS of photos: what cameras write is read, what is no position is none."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from gaussian_wrapping_addon.core.photos.exif import gps_of_tags, read_gps_exif

NORTH_EAST = {1: "N", 2: (47.0, 30.0, 36.0), 3: "E", 4: (8.0, 45.0, 0.0)}


def test_a_photo_keeps_its_position(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    exif = Image.Exif()
    exif[0x8825] = {
        1: "S", 2: (33.0, 51.0, 25.2), 3: "W", 4: (70.0, 30.0, 0.0), 5: b"\x01",
        6: Fraction(125, 10), 11: Fraction(18, 10), 18: "WGS-84", 31: Fraction(42, 10),
    }  # fmt: skip
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    found = read_gps_exif(path)
    assert found is not None
    assert found.latitude_deg == pytest.approx(-33.857)
    assert found.longitude_deg == pytest.approx(-70.5)
    assert (found.altitude_m, found.altitude_reference) == (-12.5, "sea level")
    assert (found.dop, found.error_m, found.datum) == (1.8, 4.2, "WGS-84")


@pytest.mark.parametrize(
    ("changes", "altitude", "reference"),
    [
        ({}, None, "sea level"),
        ({6: 10.0}, 10.0, "sea level"),
        ({6: 10.0, 5: b"\x00"}, 10.0, "sea level"),
        ({6: 10.0, 5: 2}, 10.0, "ellipsoid"),
        ({6: 10.0, 5: b"\x03"}, -10.0, "ellipsoid"),
        ({6: 10.0, 5: b"\x09"}, 10.0, "sea level"),
        ({6: IFDRational(1, 0)}, None, "sea level"),
        ({6: 1e9}, None, "sea level"),
        ({6: "high"}, None, "sea level"),
    ],
)
def test_altitudes(changes: dict[int, Any], altitude: float | None, reference: str) -> None:
    found = gps_of_tags({**NORTH_EAST, **changes})
    assert found is not None
    assert (found.altitude_m, found.altitude_reference) == (altitude, reference)


@pytest.mark.parametrize(
    "changes",
    [
        {1: None}, {1: "X"}, {3: ""}, {2: (91.0, 0.0, 0.0)}, {4: (180.0, 1.0, 0.0)},
        {2: (47.0, -3.0, 0.0)}, {2: (IFDRational(0, 0), 0.0, 0.0)}, {2: ()}, {2: (1, 2, 3, 4)},
        {4: "8"*5}, {2: None}, {9: "V"}, {2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)},
        {2: (float("nan"), 0.0, 0.0)}, {4: (float("inf"),)},
    ],
)  # fmt: skip
def test_what_is_no_position(changes: dict[int, Any]) -> None:
    assert gps_of_tags({**NORTH_EAST, **changes}) is None


def test_degrees_without_minutes_and_references_of_bytes() -> None:
    found = gps_of_tags({1: b"N\0", 2: (47.51,), 3: "e", 4: (8.0, 45.0)})
    assert found is not None
    assert (found.latitude_deg, found.longitude_deg) == (47.51, 8.75)


def test_files_without_gps(tmp_path: Path) -> None:
    plain = tmp_path / "a.png"
    Image.new("RGB", (8, 8)).save(plain)
    (tmp_path / "b.jpg").write_bytes(b"no photo")
    assert read_gps_exif(plain) is None
    assert read_gps_exif(tmp_path / "b.jpg") is None
    assert read_gps_exif(tmp_path / "missing.jpg") is None
