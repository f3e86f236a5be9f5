# SPDX-License-Identifier: GPL-3.0-or-later
"""What is refused before pixels are read, links in a circle, over-long names, linked folders."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.files import resolve_inside
from gaussian_wrapping_addon.core.jobs.store.stage_folder import source_fingerprint
from gaussian_wrapping_addon.core.loading.check import check_input
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.photos.finder import find_mask, resolve_photo
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.readers.model_writers import (
    HEIGHT,
    WIDTH,
    ring_model,
    ring_poses,
    write_binary,
    write_photos,
    write_project,
    write_text,
)


def photos_of(width: int, height: int, count: int) -> Callable[[Path], None]:
    """Return a writer of a set in which the first photos have another size."""

    def make(source: Path) -> None:
        write_project(source)
        for path in sorted((source / "images").iterdir())[:count]:
            Image.new("RGB", (width, height)).save(path)

    return make


def far_points(source: Path) -> None:
    model = ring_model(6, points=120)
    model.points = [(np.add(p[0], [1e4, 0.0, 0.0]), *p[1:]) for p in model.points]
    write_binary(model, source / "sparse")
    write_photos(model, source / "images")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (photos_of(HEIGHT, WIDTH, 1), r"p00.png .*rotated by 90 degrees"),
        (photos_of(WIDTH, WIDTH, 1), r"p00.png .*its camera 64 x 48"),
        (photos_of(8, 6, 5), "of 5 photos cannot be read"),
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
    assert re.search(words, error.message)
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


LONG = f"{'x' * 300}.png"
"""Longer than any file system stores."""


def make_circle(path: Path) -> None:
    """Make two links that lead to each other."""
    path.parent.mkdir(parents=True, exist_ok=True)
    other = path.with_name(f"other-{path.stem}")
    path.symlink_to(other)
    other.symlink_to(path)


def write_transforms(root: Path, names: list[str]) -> None:
    """Write cameras on a ring for photos of these names."""
    frames = []
    for name, pose in zip(names, ring_poses(len(names)), strict=True):
        world = np.linalg.inv(np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": name, "transform_matrix": world.tolist()})
    values = {"fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    (root / "transforms.json").write_text(json.dumps({**values, "frames": frames}))


def write_set(root: Path, kind: str, last: str) -> None:
    """Write five photos, and a camera more, whose photo has a name that cannot be used."""
    model, rest = ring_model(6), ring_model(6)
    rest.images.pop()
    write_photos(rest, root / "images")
    model.images[-1].name = last
    if kind == "transforms":
        names = [f"images/{image.name}" for image in rest.images]
        write_transforms(root, [*names, last if len(last) > 60 else f"images/{last}"])
    elif kind != "photos":
        (write_text if kind == "text" else write_binary)(model, root / "sparse" / "0")


@pytest.mark.parametrize("kind", ["photos", "transforms", "colmap"])
def test_links_in_a_circle_among_photos_are_left_out(tmp_path: Path, kind: str) -> None:
    make_circle(tmp_path / "images" / "p05.png")
    write_set(tmp_path, kind, "p05.png")
    findings = check_input(tmp_path)
    assert not [found for found in findings if found.severity == "error"]
    assert any("p05.png" in finding.message for finding in findings)
    assert not any("p05" in name for name, _, _ in source_fingerprint(tmp_path))
    assert resolve_inside(tmp_path, "images/p05.png") in (None, tmp_path / "images" / "p05.png")


@pytest.mark.parametrize("kind", ["transforms", "binary", "text"])
@pytest.mark.parametrize("name", [LONG, f"{'x' * 2000}.png", f"{'y/' * 400}{'x' * 300}.png"])
def test_an_over_long_name_is_left_out_and_named(tmp_path: Path, kind: str, name: str) -> None:
    write_set(tmp_path, kind, name)
    findings = check_input(tmp_path)
    assert not [found for found in findings if found.severity == "error"]
    assert any(name[:60] in finding.message for finding in findings)
    assert len(load_scene(tmp_path, tmp_path / "work", Progress()).views) == 5


def test_a_name_that_only_its_mask_makes_too_long_has_no_mask(tmp_path: Path) -> None:
    """``x.png`` of 253 characters is stored, its mask ``x.png.png`` cannot be."""
    name = f"{'x' * 249}.png"
    (tmp_path / name).write_bytes(b"")
    assert find_mask([tmp_path / "masks"], name) is None
    (tmp_path / "masks").mkdir()
    assert find_mask([tmp_path / "masks"], name) is None
    (tmp_path / "masks" / name).write_bytes(b"")
    assert find_mask([tmp_path / "masks"], name) == tmp_path / "masks" / name


pytestmark = pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
COUNT = 6


def transforms(root: Path) -> None:
    model = write_project(root, COUNT)
    shutil.rmtree(root / "sparse")
    write_transforms(root, [f"images/{image.name}" for image in model.images])


@pytest.mark.parametrize("write", [partial(write_project, count=COUNT), transforms])
@pytest.mark.parametrize("names", ["flat", "below"])
def test_a_linked_folder_of_photos_is_taken(
    tmp_path: Path, write: Callable[[Path], None], names: str
) -> None:
    root, elsewhere = tmp_path / "set", tmp_path / "another disk"
    write(root)
    if names == "below" and write is transforms:
        # Two photos of the same name, which no loose rule could tell apart.
        text = (root / "transforms.json").read_text().replace("images/p0", "images/left/p0")
        (root / "transforms.json").write_text(text.replace("left/p05", "right/p04"))
        for number in range(COUNT):
            side, name = ("right", "p04") if number == 5 else ("left", f"p{number:02d}")
            (root / "images" / side).mkdir(exist_ok=True)
            (root / "images" / f"p{number:02d}.png").rename(root / "images" / side / f"{name}.png")
    (root / "images").rename(elsewhere)
    (root / "images").symlink_to(elsewhere)
    assert not [found for found in check_input(root) if found.severity == "error"]
    scene = load_scene(root, tmp_path / "work", Progress(), seed=0, threads=1)
    assert len(scene.views) == COUNT


def test_what_leads_out_of_a_linked_folder_is_not_taken(tmp_path: Path) -> None:
    root, elsewhere = tmp_path / "set", tmp_path / "elsewhere"
    root.mkdir()
    (elsewhere / "masks").mkdir(parents=True)
    (elsewhere / "a.png").touch()
    (tmp_path / "private.png").touch()
    (elsewhere / "b.png").symlink_to(tmp_path / "private.png")
    (root / "images").symlink_to(elsewhere)
    (root / "masks").symlink_to(elsewhere / "masks")
    (root / "other").symlink_to(elsewhere)
    assert resolve_photo(root, "images/a.png") == root / "images" / "a.png"
    assert resolve_photo(root, "images\\a.png") == root / "images" / "a.png"
    assert resolve_photo(root, "masks/a.png.png") == root / "masks" / "a.png.png"
    for name in (
        "images/b.png", "images/../private.png", "images//etc/passwd", "other/a.png", "images/",
        "images", "images/../images/a.png", "../elsewhere/a.png",
    ):  # fmt: skip
        assert resolve_photo(root, name) is None, name
