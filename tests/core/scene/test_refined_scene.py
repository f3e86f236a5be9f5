# SPDX-License-Identifier: GPL-3.0-or-later
"""A saved scene with refined poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.scene.scene import (
    POSES_NAME,
    Scene,
    View,
    load_refined_scene,
    save_poses,
    save_scene,
    with_poses,
)
from tests.core.training.small_scene import sphere_scene


@pytest.fixture
def saved(tmp_path: Path) -> Scene:
    scene, photos = sphere_scene()
    views = []
    for view, photo in zip(scene.views, photos.photos, strict=True):
        path = tmp_path / view.camera.name
        Image.fromarray(photo).save(path)
        views.append(View(view.camera, path))
    kept = Scene(tuple(views), scene.points, scene.point_colors, scene.world_from_scene)
    for name in ("cameras", "train"):
        (tmp_path / name).mkdir()
    save_scene(kept, tmp_path / "cameras")
    return kept


def poses_of(scene: Scene) -> np.ndarray:
    return np.array([view.camera.cam_from_world for view in scene.views])


def test_poses_come_back_and_all_else_stays(saved: Scene, tmp_path: Path) -> None:
    folders = tmp_path / "cameras", tmp_path / "train"
    assert np.array_equal(poses_of(load_refined_scene(*folders)), poses_of(saved))
    poses = poses_of(saved)
    poses[:, :, 3] += np.random.default_rng(0).normal(size=(len(poses), 3))
    save_poses(tmp_path / "train", poses)
    found = load_refined_scene(*folders)
    assert np.array_equal(poses_of(found), poses)
    back = with_poses(found, poses_of(saved))
    for one, other in zip(back.views, saved.views, strict=True):
        assert one.photo_path == other.photo_path
        assert one.camera.to_json() == other.camera.to_json()
    assert np.array_equal(found.points, saved.points)
    save_poses(tmp_path / "train", None)  # the training was done again, and refined none
    assert np.array_equal(poses_of(load_refined_scene(*folders)), poses_of(saved))


def test_poses_that_are_none_are_refused(saved: Scene, tmp_path: Path) -> None:
    path, poses = tmp_path / "train" / POSES_NAME, poses_of(saved)
    broken = poses.copy()
    broken[2, :, :3] *= 1.01
    holes = poses.copy()
    holes[1, 0, 3] = np.nan
    for wrong in (poses[:-1], broken, holes):
        save_poses(tmp_path / "train", wrong)
        with pytest.raises(ParseError, match="camera_poses"):
            load_refined_scene(tmp_path / "cameras", tmp_path / "train")
    save_poses(tmp_path / "train", poses)
    whole = path.read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"\0" * 64):
        path.write_bytes(content)
        with pytest.raises(ParseError, match="camera_poses"):
            load_refined_scene(tmp_path / "cameras", tmp_path / "train")
