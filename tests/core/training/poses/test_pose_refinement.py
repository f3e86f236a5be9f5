# SPDX-License-Identifier: GPL-3.0-or-later
"""Training on cameras that are a pixel off brings them back."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.scene import Scene, with_poses
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.camera_poses import CameraPoses
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.training.small_scene import PhotosInMemory, sphere_scene
from tests.core.training.test_trainer import StopAt, assert_same

SETTINGS = TrainingSettings(
    iterations=400, max_gaussians=800, max_image_px=64, sh_degree=0, harmonics="off",
    exposure="off", wrapping="off", growth="off", full_size="on", dense_start="off",
    refine_poses="on", holdout_every=0, preview_every_s=0.0,
)  # fmt: skip


def shaken(scene: Scene, size_px: float) -> Scene:
    """Return the scene with each camera turned by about so many pixels."""
    random, poses = np.random.default_rng(4), []
    for view in scene.views:
        turn = random.normal(size=3) * size_px / view.camera.fx
        poses.append(Rotation.from_rotvec(turn).as_matrix() @ view.camera.cam_from_world)
    return with_poses(scene, np.array(poses))


def errors_px(poses: np.ndarray, scene: Scene) -> np.ndarray:
    """Return how far poses are from those of a scene, pixels."""
    true = np.array([view.camera.cam_from_world for view in scene.views])
    found = CameraPoses(true, range(len(true)))
    found.refined[...] = poses
    found.anchor()
    cameras = {k: view.camera for k, view in enumerate(scene.views)}
    return found.shifts_px(cameras, scene.points)


def test_cameras_a_pixel_off_come_back(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=20, size_px=64)
    wrong = shaken(scene, 1.0)
    seen = PhotosInMemory(wrong, photos.photos)
    found = train(wrong, seen, SETTINGS, tmp_path, Progress(), threads=1)
    given = np.array([view.camera.cam_from_world for view in wrong.views])
    assert np.median(errors_px(given, scene)) > 0.9
    assert found.poses is not None
    assert np.median(errors_px(found.poses, scene)) < 0.5
    assert found.history[-1]["psnr"] > 31.0  # 25.6 dB with the poses that were given
    assert found.model_selection.chose("refine_poses")


def test_poses_that_are_not_to_move_do_not(tmp_path: Path) -> None:
    scene, photos = sphere_scene()
    settings = dataclasses.replace(SETTINGS, iterations=20, max_image_px=32, refine_poses="auto")
    found = train(scene, photos, settings, tmp_path, Progress(), threads=1)
    assert found.poses is None  # no dense start
    assert found.model_selection.chose("refine_poses", "off")


def test_a_resumed_training_has_the_same_poses(tmp_path: Path) -> None:
    scene, photos = sphere_scene()
    settings = dataclasses.replace(SETTINGS, iterations=40, max_image_px=32)
    folders = tmp_path / "whole", tmp_path / "cut"
    for folder in folders:
        folder.mkdir()
    whole = train(scene, photos, settings, folders[0], Progress(), threads=1)
    watch = StopAt(23)
    with pytest.raises(Cancelled):
        train(scene, photos, settings, folders[1], watch.progress(), threads=1)
    again = train(scene, photos, settings, folders[1], Progress(), threads=2)
    assert whole.poses is not None
    assert np.array_equal(whole.poses, again.poses)
    assert_same(whole.gaussians, again.gaussians)
