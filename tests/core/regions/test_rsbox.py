# SPDX-License-Identifier: GPL-3.0-or-later
"""Reconstruction regions: the box of a file worked out by hand, round trips, files to refuse."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import DatasetError, ParseError, UsageError
from gaussian_wrapping_addon.core.regions.files import (
    MAX_BYTES,
    angles_of,
    read_region_file,
    read_rsbox,
    rotation_of,
    write_region_file,
    write_rsbox,
)

ATTRIBUTES = """<ReconstructionRegion globalCoordinateSystem="NONE"
   globalCoordinateSystemWkt="NONE" globalCoordinateSystemName="NONE" isGeoreferenced="0"
   isLatLon="0" yawPitchRoll="{angles}" widthHeightDepth="{size}">
  <Header magic="5395016" version="2"/>
  <CentreEuclid centre="{centre}"/>
  <Residual R="1 0 0 0 1 0 0 0 1" t="0 0 0" s="1" ownerId="{{D0}}"/>
</ReconstructionRegion>
"""
ELEMENTS = """<?xml version="1.0" encoding="UTF-8"?>
<ReconstructionRegion globalCoordinateSystem="+proj=geocent +ellps=WGS84 +no_defs"
   globalCoordinateSystemName="local:1 - Euclidean" isGeoreferenced="1" isLatLon="0">
  <yawPitchRoll>{angles}</yawPitchRoll>
  <widthHeightDepth>{size}</widthHeightDepth>
  <Header magic="5395016" version="2"/>
  <CentreEuclid><centre>{centre}</centre></CentreEuclid>
  <Residual R="1 0 0 0 1 0 0 0 1" t="0 0 0" s="1"/>
</ReconstructionRegion>
"""
FORMS = {"attributes": ATTRIBUTES, "elements": ELEMENTS}
GOOD = {"angles": "0 -0 -0", "size": "2 4 6", "centre": "10 20 30"}


def written(path: Path, form: str = ATTRIBUTES, **values: str) -> Path:
    path.write_text(form.format(**{**GOOD, **values}), encoding="utf-8")
    return path


def as_set(vertices: np.ndarray) -> set[tuple[float, ...]]:
    return {tuple(row) for row in (np.round(vertices, 9) + 0.0).tolist()}


def corners(x: tuple[float, ...], y: tuple[float, ...], z: tuple[float, ...]) -> set[tuple]:
    return set(itertools.product(x, y, z))


# Width, height and depth of 2, 4, 6 along x, y and z, and the box turned by quarter turns: worked
# out on paper from what the program writes for a rotation of its own. It stores a turn of +90
# degrees about y as yaw -90, about x as pitch -90, about z as roll -90.
BY_HAND = {
    "upright": ("0 -0 -0", corners((9, 11), (18, 22), (27, 33))),
    "90 about z": ("0 -0 -90", corners((8, 12), (19, 21), (27, 33))),
    "90 about x": ("0 -90 -0", corners((9, 11), (17, 23), (28, 32))),
    "90 about y": ("-90 -0 -0", corners((7, 13), (18, 22), (29, 31))),
    # First about x (y and z swap), then about y (x and z swap).
    "x, then y": ("-90 -90 -0", corners((8, 12), (17, 23), (29, 31))),
    # First about y (x and z swap), then about z (x and y swap).
    "y, then z": ("-90 -0 -90", corners((8, 12), (17, 23), (29, 31))),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", BY_HAND)
def test_boxes_worked_out_by_hand(tmp_path: Path, form: str, name: str) -> None:
    angles, wanted = BY_HAND[name]
    assert as_set(read_rsbox(written(tmp_path / "a.rsbox", FORMS[form], angles=angles))) == wanted


def test_the_order_and_signs_of_the_angles() -> None:
    """A point carried through three turns one by one, with sines and cosines of 30 degrees."""
    s, c = 0.5, np.sqrt(0.75)
    x, y, z = 1.0, 2.0, 3.0
    y, z = c * y - s * z, s * y + c * z  # +30 about x: pitch -30
    x, z = c * x + s * z, -s * x + c * z  # +30 about y: yaw -30
    x, y = c * x - s * y, s * x + c * y  # +30 about z: roll -30
    turned = rotation_of(-30.0, -30.0, -30.0) @ [1.0, 2.0, 3.0]
    np.testing.assert_allclose(turned, [x, y, z], atol=1e-15)


@pytest.mark.parametrize("middle", [0.0, 35.0, -89.9, 90.0, -90.0])
def test_angles_give_their_rotation_again(middle: float) -> None:
    rotation = rotation_of(middle, 20.0, -130.0)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation_of(*angles_of(rotation)), rotation, atol=2e-6)


@pytest.mark.parametrize("seed", range(8))
def test_what_is_written_is_read_again(tmp_path: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    axes = np.linalg.qr(random.normal(size=(3, 3)))[0]
    box = random.normal(size=3) * 50 + (signs * random.uniform(0.2, 9.0, 3)) @ axes.T
    path = tmp_path / "again.rsbox"
    write_rsbox(path, random.permutation(box))
    again = read_rsbox(path)
    distances = np.linalg.norm(again[:, None] - box[None], axis=2)
    assert distances.min(0).max() < 1e-6
    assert distances.min(1).max() < 1e-6
    assert [p.name for p in tmp_path.iterdir()] == ["again.rsbox"]


def test_a_region_file_may_be_a_reconstruction_region(tmp_path: Path) -> None:
    region = read_region_file(written(tmp_path / "Front Door.RSBOX"))
    assert region.name == "Front Door"
    assert as_set(region.vertices) == BY_HAND["upright"][1]


def test_only_boxes_can_be_written(tmp_path: Path) -> None:
    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    with pytest.raises(UsageError, match=r"'Head' is no box.*Export it as \.json"):
        write_region_file(tmp_path / "a.rsbox", "Head", tetrahedron)
    assert list(tmp_path.iterdir()) == []


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;">]>\n' + ATTRIBUTES
BAD = {
    "empty": ("", "line 1: not XML"),
    "cut": (ATTRIBUTES.format(**GOOD)[:200], "not XML"),
    "a document type": (BOMB.format(**GOOD), "DOCTYPE is not allowed"),
    "another root": ("<Region/>", "root: is 'Region'"),
    "no size": (ATTRIBUTES.format(**GOOD).replace("widthHeightDepth", "x"), "widthHeightDepth: is"),
    "no angles": (ATTRIBUTES.format(**GOOD).replace("yawPitchRoll", "x"), "yawPitchRoll: is mis"),
    "no centre": (ATTRIBUTES.format(**GOOD).replace("CentreEuclid", "x"), "CentreEuclid: is miss"),
    "NaN": (ATTRIBUTES.format(**{**GOOD, "size": "nan 1 1"}), "is not 3 finite numbers"),
    "infinite": (ATTRIBUTES.format(**{**GOOD, "centre": "1e999 1 1"}), "is not 3 finite"),
    "two numbers": (ATTRIBUTES.format(**{**GOOD, "angles": "1 2"}), "is not 3 finite"),
    "words": (ATTRIBUTES.format(**{**GOOD, "angles": "a b c"}), "is not 3 finite"),
    "no thickness": (ATTRIBUTES.format(**{**GOOD, "size": "1 0 1"}), "a side is not above 0"),
    "mirrored": (ATTRIBUTES.format(**{**GOOD, "size": "1 -1 1"}), "a side is not above 0"),
    "degrees of longitude": (
        ATTRIBUTES.format(**GOOD).replace('isLatLon="0"', 'isLatLon="1"'), "not a local Euclidean",
    ),
    "a map": (
        ATTRIBUTES.format(**GOOD).replace('Name="NONE"', 'Name="epsg:32632"'), "'epsg:32632' is n",
    ),
    "a residual scale": (ATTRIBUTES.format(**GOOD).replace('s="1"', 's="2"'), "Residual s"),
    "a residual turn": (
        ATTRIBUTES.format(**GOOD).replace('R="1 0 0', 'R="0 1 0'), "Residual R: is not that of the",
    ),
    "too large": (ATTRIBUTES.format(**GOOD) + " " * MAX_BYTES, "bytes are too many"),
    "deep": ("<a>" * 9000 + "</a>" * 5000, "not XML"),
    "NUL": (ATTRIBUTES.format(**GOOD) + "\0", "not XML"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_by_name(tmp_path: Path, name: str) -> None:
    text, says = BAD[name]
    path = tmp_path / "bad.rsbox"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ParseError) as refused:
        read_region_file(path)
    assert says in str(refused.value)
    assert str(refused.value).startswith("bad.rsbox, ")
    assert refused.value.hint


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_other_encodings_hide_nothing(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "bad.rsbox"
    path.write_bytes(BOMB.format(**{**GOOD, "angles": "é"}).encode(encoding))
    with pytest.raises(ParseError, match="not UTF-8"):
        read_rsbox(path)


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    (tmp_path / "folder.rsbox").mkdir()
    for name in ("none.rsbox", "folder.rsbox"):
        with pytest.raises(DatasetError, match=name):
            read_region_file(tmp_path / name)


def test_convert_region(tmp_path: Path) -> None:
    source, middle, back = (tmp_path / n for n in ("a.rsbox", "a.json", "b.rsbox"))
    written(source, angles="-12 34 -56")
    assert batch.main(["convert-region", str(source), str(middle)]) == 0
    assert json.loads(middle.read_text())["class_name"] == "GaussianWrappingBoundingVolume"
    assert batch.main(["convert-region", str(middle), str(back)]) == 0
    first, again = read_rsbox(source), read_rsbox(back)
    distances = np.linalg.norm(again[:, None] - first[None], axis=2)
    assert distances.min(0).max() < 1e-9
    assert batch.main(["convert-region", str(source), str(tmp_path / "a.xml")]) == 2
    assert batch.main(["convert-region", str(tmp_path / "no.rsbox"), str(middle)]) == 3
    assert batch.main(["convert-region", str(source), str(tmp_path / "no" / "a.json")]) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "a.rsbox", "b.rsbox"]
