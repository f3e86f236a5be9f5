# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions: the body, its file, and bad files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import DatasetError, MeshingError, ParseError
from gaussian_wrapping_addon.core.limits import MAX_NAME_BYTES
from gaussian_wrapping_addon.core.regions.files import read_region_file
from gaussian_wrapping_addon.core.regions.scene_regions import read_region, write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Similarity

TURN = Rotation.from_euler("xyz", [20, 30, 50], degrees=True).as_matrix()
UTM = np.array([5e5, 4e6, 120.0])


def turned_box(offset: np.ndarray | float = 0.0) -> Region:
    box = Region.box("thing", [-1, -2, -3], [1, 2, 3], TURN)
    return Region("thing", box.vertices + offset)


@pytest.mark.parametrize("offset", [np.zeros(3), UTM])
def test_box_contains_what_lies_between_its_corners(offset: np.ndarray) -> None:
    region = turned_box(offset)
    local = np.random.default_rng(0).uniform(-4, 4, (4000, 3))
    inside = (np.abs(local) <= [1, 2, 3]).all(1)
    np.testing.assert_array_equal(region.contains(local @ TURN.T + offset), inside)
    assert region.volume == pytest.approx(48, rel=1e-9)
    assert region.area == pytest.approx(2 * (2 * 4 + 2 * 6 + 4 * 6), rel=1e-9)
    # The largest half-space distance is exact outside a face.
    np.testing.assert_allclose(
        region.distance(np.array([[0.0, 0, 5]]) @ TURN.T + offset), 2.0, rtol=1e-8
    )


def test_box_has_six_faces_and_twelve_edges() -> None:
    region = turned_box()
    normals, offsets = region.half_spaces
    assert len(offsets) == len(region.faces()) == 6
    lengths = np.sort(np.linalg.norm(np.diff(region.edges(), axis=1)[:, 0], axis=1))
    np.testing.assert_allclose(lengths, [2] * 4 + [4] * 4 + [6] * 4)
    for triangles, normal in zip(region.faces(), normals, strict=True):
        cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        np.testing.assert_allclose(cross / np.linalg.norm(cross, axis=1)[:, None], [normal] * 2,
                                   atol=1e-12)  # fmt: skip


def test_transform_commutes_with_contains() -> None:
    scene_from_world = Similarity(0.01, TURN, np.array([1.0, 2.0, 3.0]))
    world = turned_box(UTM)
    points = np.random.default_rng(1).uniform(-4, 4, (1000, 3)) + UTM
    scene = world.transformed(scene_from_world)
    np.testing.assert_array_equal(
        scene.contains(scene_from_world.points(points)), world.contains(points)
    )
    assert scene.diagonal == pytest.approx(np.linalg.norm(np.ptp(scene.vertices, axis=0)))
    assert scene.name == "thing"


def test_round_trip_keeps_every_digit(tmp_path: Path) -> None:
    vertices = np.random.default_rng(2).normal(size=(40, 3)) + UTM
    path = tmp_path / "region.json"
    write_region(path, Region("Würfel 1", vertices))
    again = read_region(path)
    assert again.name == "Würfel 1"
    np.testing.assert_array_equal(again.vertices, vertices)
    values = json.loads(path.read_text())
    assert values["class_name"] == "GaussianWrappingBoundingVolume"
    assert values["version"] == 1
    assert np.array(values["hull_simplices"]).max() < 40
    assert list(tmp_path.iterdir()) == [path]


CUBE = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]


def body(**changes: Any) -> dict[str, Any]:
    values = {
        "class_name": "GaussianWrappingBoundingVolume",
        "version": 1,
        "blender_object_name": "Cube",
        "vertices": CUBE,
        "hull_simplices": None,
    }
    return {**values, **changes}


@pytest.mark.parametrize(
    "values",
    [
        body(),
        body(hull_simplices=[[0, 1, 99]]),
        {k: v for k, v in body().items() if k != "hull_simplices"},
        body(blender_object_name=None),
        body(blender_object_name=" "),
        body(extra={"a": 1}),
        body(vertices=[*CUBE, [0.5, 0.5, 0.5]]),
        body(vertices=[*CUBE, *CUBE]),
    ],
)
def test_variants_that_are_read(values: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "roi.json"
    path.write_text(json.dumps(values))
    region, file = read_region(path), read_region_file(path)
    assert region.volume == pytest.approx(1)
    assert region.name in ("Cube", "roi")
    assert file.name == region.name
    np.testing.assert_array_equal(file.vertices, region.vertices)


@pytest.mark.parametrize(
    ("name", "clean"),
    [
        ("\ud800x", "?x"),
        ("x\udfff", "x?"),
        ("a\0b", "ab"),
        ("\0", "roi"),
        ("Würfel \U0001f600", "Würfel \U0001f600"),
        ("ü" * 600, "ü" * 512),  # 1024 bytes
        ("x" + "ü" * 600, "x" + "ü" * 511),  # no half letter
    ],
)
def test_names_can_be_written_anywhere(name: str, clean: str, tmp_path: Path) -> None:
    path = tmp_path / "roi.json"
    path.write_text(json.dumps(body(blender_object_name=name)))
    region = read_region(path)
    assert region.name == clean
    assert len(region.name.encode()) <= MAX_NAME_BYTES
    write_region(path, region)
    assert read_region(path).name == clean


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (json.dumps(body(class_name="Other")), "class_name"),
        (json.dumps(body(class_name=None)), "class_name"),
        (json.dumps(body(version=2)), "version"),
        (json.dumps(body(version=True)), "version"),
        (json.dumps(body(version="1")), "version"),
        (json.dumps(body(vertices=None)), "vertices"),
        (json.dumps(body(vertices=CUBE[:3])), "vertices"),
        (json.dumps(body(vertices=[[0, 0]] * 8)), "vertices[0]"),
        (json.dumps(body(vertices=[*CUBE, [0, 0, "1"]])), "vertices[8]"),
        (json.dumps(body(vertices=[*CUBE, [0, 0, True]])), "vertices[8]"),
        (json.dumps(body(vertices=[*CUBE, [0, 0, 10**400]])), "vertices[8]"),
        (json.dumps(body(vertices=[*CUBE, [0, 0, 1e300]])), "vertices[8]"),
        (json.dumps(body(vertices=[[x, y, 0] for x, y, _ in CUBE])), "vertices"),
        (json.dumps(body(vertices=[[x, x, x] for x in range(9)])), "vertices"),
        (json.dumps(body(vertices=[[1, 1, 1]] * 9)), "vertices"),
        (json.dumps(body(vertices=[[0, 0, 0]] * 10_001)), "vertices"),
        (json.dumps(body(vertices=[*CUBE, [0, 0, float("nan")]])), "whole file"),
        (json.dumps([body()]), "top level"),
        ("", "line 1"),
        ("{", "line 1"),
        ("[" * 100_000, "whole file"),
    ],
)
def test_bad_files_are_refused_with_their_place(text: str, place: str, tmp_path: Path) -> None:
    path = tmp_path / "roi.json"
    path.write_text(text)
    for read in (read_region, read_region_file):  # the worker's, Blender's
        with pytest.raises(ParseError) as caught:
            read(path)
        assert caught.value.location == place
        assert "roi.json" in caught.value.message
        assert caught.value.hint


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none\.json does not exist"):
        read_region(tmp_path / "none.json")
    with pytest.raises(DatasetError, match="is a folder"):
        read_region(tmp_path)


@pytest.mark.parametrize("height", [0.0, 1e-9])
def test_flat_body_is_refused(height: float) -> None:
    with pytest.raises(MeshingError, match="flat"):
        Region.box("plane", [0, 0, 0], [1, 1, height])
    with pytest.raises(MeshingError, match="finite"):
        Region("nan", np.full((5, 3), np.nan))


def test_concave_corners_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "roi.json"
    path.write_text(json.dumps(body(vertices=[*CUBE, [0.5, 0.5, 0.2]])))
    read_region(path)
    assert "1 of 9 corners lie inside the convex hull" in caplog.text
