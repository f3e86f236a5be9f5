# SPDX-License-Identifier: GPL-3.0-or-later
"""Crop volumes: concave polygons along every axis, and errors of invalid files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.evaluation.layouts import PolygonVolume, read_polygon_volume

# The letter U, 3 wide and 3 high, with a gap of 1 from above.
LETTER = np.array([[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]], float)
PLANES = {"X": (1, 2, 0), "Y": (0, 2, 1), "Z": (0, 1, 2)}


def volume(axis: str) -> PolygonVolume:
    u, v, w = PLANES[axis]
    corners = np.full((len(LETTER), 3), 99.0)
    corners[:, u], corners[:, v] = LETTER[:, 0], LETTER[:, 1]
    corners[:, w] = 7.0  # not used
    return PolygonVolume(corners, axis, -1.0, 2.0)


@pytest.mark.parametrize("axis", "XYZ")
def test_a_concave_polygon_along_every_axis(axis: str, tmp_path: Path) -> None:
    path = tmp_path / "crop.json"
    path.write_text(json.dumps(volume(axis).to_json()))
    crop = read_polygon_volume(path)
    u, v, w = PLANES[axis]
    points = np.random.default_rng(0).uniform(-2, 4, (20_000, 3))
    x, y, height = points[:, u], points[:, v], points[:, w]
    letter = (x > 0) & (x < 3) & (y > 0) & (y < 3) & ~((x > 1) & (x < 2) & (y > 1))
    np.testing.assert_array_equal(crop.inside(points), letter & (height > -1) & (height < 2))
    low, high = crop.bounds()
    assert (low[u], high[v], low[w], high[w]) == (0, 3, -1, 2)


def test_borders_belong_to_one_side() -> None:
    left = PolygonVolume(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float), "Z", 0, 1)
    right = PolygonVolume(left.polygon + np.array([1, 0, 0]), "Z", 0, 1)
    edge = np.array([[1.0, y, 0.5] for y in np.linspace(0, 0.99, 12)])
    assert not left.inside(edge).any()
    assert right.inside(edge).all()
    assert left.inside(np.array([[0.0, 0, 0], [0.5, 0.5, 1.0]])).all()
    assert not left.inside(np.array([[0.5, 0.5, 1.0 + 1e-9], [np.nan, 0.5, 0.5]])).any()


@pytest.mark.parametrize(
    ("change", "place"),
    [
        ({"orthogonal_axis": "W"}, "orthogonal_axis"),
        ({"axis_min": 5.0}, "axis_min"),
        ({"axis_max": None}, "axis_max"),
        ({"bounding_polygon": [[0, 0, 0]]}, "bounding_polygon"),
        ({"bounding_polygon": [[0, 0, 0], [1, 0], [1, 1, 0]]}, r"bounding_polygon\[1\]"),
        ({"version_major": 2}, "version_major"),
        ({"class_name": "Other"}, "class_name"),
    ],
)
def test_bad_files_are_refused_by_place(change: dict, place: str, tmp_path: Path) -> None:
    path = tmp_path / "crop.json"
    path.write_text(json.dumps({**volume("Z").to_json(), **change}))
    with pytest.raises(ParseError, match=place):
        read_polygon_volume(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ParseError, match=r"Barn\.json"):
        read_polygon_volume(tmp_path / "Barn.json")
