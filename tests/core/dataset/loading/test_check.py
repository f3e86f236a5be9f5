# SPDX-License-Identifier: GPL-3.0-or-later
"""What loading refuses before it reads pixels, the quick check refuses with the same words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.loading.check import check_input
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.dataset.model_writers import (
    HEIGHT,
    WIDTH,
    ring_model,
    write_binary,
    write_photos,
    write_project,
)


def turned_photo(source: Path) -> None:
    write_project(source)
    Image.new("RGB", (HEIGHT, WIDTH)).save(source / "images" / "p03.png")


def cut_photo(source: Path) -> None:
    write_project(source)
    Image.new("RGB", (WIDTH, WIDTH)).save(source / "images" / "p03.png")


def icons(source: Path) -> None:
    write_project(source)
    for path in (source / "images").iterdir():
        Image.new("RGB", (8, 6)).save(path)


def far_points(source: Path) -> None:
    model = ring_model(6, points=120)
    model.points = [(np.add(p[0], [1e4, 0.0, 0.0]), *p[1:]) for p in model.points]
    write_binary(model, source / "sparse")
    write_photos(model, source / "images")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (turned_photo, "rotated by 90 degrees"),
        (cut_photo, "its camera 64 x 48"),
        (icons, "of 5 photos cannot be read"),
        (far_points, "from nearly one place"),
    ],
)
def test_the_check_refuses_what_loading_refuses(
    tmp_path: Path, make: Callable[[Path], None], words: str
) -> None:
    source = tmp_path / "set"
    make(source)
    with pytest.raises(DatasetError, match=words):
        load_scene(source, tmp_path / "work", Progress(), threads=1)
    (error,) = [found for found in check_input(source) if found.severity == "error"]
    assert words in error.message
    assert error.hint


def test_the_check_warns_of_points_that_loading_leaves_out(tmp_path: Path) -> None:
    model = ring_model(6, points=120)
    model.points[5] = ([1e9, 0.0, 0.0], *model.points[5][1:])
    write_binary(model, tmp_path / "set" / "sparse")
    write_photos(model, tmp_path / "set" / "images")
    scene = load_scene(tmp_path / "set", tmp_path / "work", Progress(), threads=1)
    (warned,) = [warning.text for warning in scene.warnings if "sparse points" in warning.text]
    assert warned in [found.message for found in check_input(tmp_path / "set")]


@pytest.mark.parametrize("path", ["a" * 300, "/".join(["b" * 200] * 30)], ids=["name", "path"])
def test_paths_that_are_too_long_are_told_shortly_and_with_a_next_step(path: str) -> None:
    (finding,) = check_input(Path(path))
    assert finding.severity == "error"
    assert "longer than this system stores" in finding.message
    assert len(finding.message) < 250
    assert finding.hint == "Use shorter names."
