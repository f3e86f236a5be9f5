# SPDX-License-Identifier: GPL-3.0-or-later
"""A linked folder of photos is taken by every kind of input; what leads out of it is not."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.loading.check import check_input
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.photos.finder import resolve_photo
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.dataset.model_writers import ring_poses, write_project

pytestmark = pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")

COUNT = 6


def colmap(root: Path) -> None:
    write_project(root, COUNT)


def transforms(root: Path) -> None:
    model = write_project(root, COUNT)
    shutil.rmtree(root / "sparse")
    frames = []
    for image, pose in zip(model.images, ring_poses(COUNT), strict=True):
        world = np.linalg.inv(np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"images/{image.name}", "transform_matrix": world.tolist()})
    size = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 60.0}
    (root / "transforms.json").write_text(json.dumps({**size, "frames": frames}))


@pytest.mark.parametrize("write", [colmap, transforms])
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
    findings = check_input(root)
    assert [finding for finding in findings if finding.severity == "error"] == []
    (tmp_path / "work").mkdir()
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
