# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos with few points and photos that look elsewhere, from models as written by solvers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.loading.check import coverage_warnings, listed
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.loading.photo_quality import photo_findings
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.readers.colmap import read_colmap
from gaussian_wrapping_addon.core.scene.camera import quaternion_from_rotation
from tests.core.dataset.model_writers import (
    Model,
    ring_model,
    write_binary,
    write_photos,
    write_text,
)
from tests.core.dataset.real_sets import real_set
from tests.poses import look_at_pose

COUNT = 8


def model_of(observed: list[int], none: int = 2**64 - 1) -> Model:
    """A ring of cameras, each of which sees so many of 400 points, and as many corners without.

    ``none`` is the number of no point: unsigned in binary files.
    """
    model = ring_model(COUNT, points=400)
    for image, count in zip(model.images, observed, strict=True):
        image.points2d = [(1.5, 2.5, 1 + j) for j in range(count)] + [(3.5, 4.5, none)] * count
    return model


@pytest.mark.parametrize(("write", "none"), [(write_binary, 2**64 - 1), (write_text, -1)])
def test_points_in_a_photo_are_counted(tmp_path: Path, write: object, none: int) -> None:
    model = model_of([3 * k for k in range(COUNT)], none)
    write(model, tmp_path / "sparse")  # type: ignore[operator]
    assert [p.observed for p in read_colmap(tmp_path).photos] == [3 * k for k in range(COUNT)]


def test_a_photo_with_few_points_is_named(tmp_path: Path) -> None:
    write_binary(model_of([300] * 5 + [25, 300, 31]), tmp_path / "sparse")
    (warning,) = coverage_warnings(read_colmap(tmp_path))
    assert warning.code == "photos-weak"
    assert warning.text == "p05.png: far fewer sparse points than in the other photos."
    assert warning.hint
    write_binary(model_of([300, 100, 35, 60, 200, 300, 90, 250]), tmp_path / "sparse")
    assert coverage_warnings(read_colmap(tmp_path)) == []


def turned_away() -> Model:
    model = model_of([300] * COUNT)
    away = look_at_pose(np.array([3.0, 0.0, 1.0]), np.array([9.0, 0.0, 1.0]))
    model.images[2].quaternion = quaternion_from_rotation(away[:, :3])
    model.images[2].translation = away[:, 3]
    return model


def test_a_photo_that_looks_elsewhere_is_named(tmp_path: Path) -> None:
    model = turned_away()
    write_binary(model, tmp_path / "set" / "sparse")
    write_photos(model, tmp_path / "set" / "images")
    (warning,) = coverage_warnings(read_colmap(tmp_path / "set"))
    assert warning.code == "photos-elsewhere"
    assert warning.text.startswith("p02.png: ")
    scene = load_scene(tmp_path / "set", tmp_path / "work", Progress(), threads=1)
    assert "photos-elsewhere" in [w.code for w in scene.warnings]
    told = photo_findings(tmp_path / "set", Progress(), threads=1)
    assert warning.text in [f.message for f in told]


def test_too_few_points_tell_nothing(tmp_path: Path) -> None:
    model = turned_away()
    model.points = model.points[:50]
    write_binary(model, tmp_path / "sparse")
    assert coverage_warnings(read_colmap(tmp_path)) == []


@pytest.mark.parametrize("name", ["banana", "flowerpot", "fox"])
def test_good_sets_are_not_spoken_of(name: str) -> None:
    assert coverage_warnings(read_colmap(real_set(name))) == []


def test_long_lists_are_cut() -> None:
    assert listed(["a", "b"]) == "a, b"
    assert listed([str(k) for k in range(6)]) == "0, 1, 2, 3, 4 and 1 other"
    assert listed([str(k) for k in range(9)]) == "0, 1, 2, 3, 4 and 4 others"
