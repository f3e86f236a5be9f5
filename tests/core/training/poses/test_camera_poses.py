# SPDX-License-Identifier: GPL-3.0-or-later
"""Refined poses: steps, what cameras share, giving up, storage."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.camera_poses import (
    LARGEST_RATE_PX,
    LAST_SHARE,
    LEAST_VIEWS,
    SMALLEST_RATE_PX,
    TRAVEL_PX,
    CameraPoses,
    PosedPhotos,
    pose_rate_px,
)
from tests.core.training.small_scene import ring_cameras, sphere_scene

COUNT = 8
POINTS = np.random.default_rng(1).normal(size=(200, 3))


def cameras() -> list[Camera]:
    return ring_cameras(COUNT, 400)


def poses(trained: range = range(1, COUNT)) -> CameraPoses:
    return CameraPoses(np.array([c.cam_from_world for c in cameras()]), trained)


def shifts(found: CameraPoses) -> np.ndarray:
    return found.shifts_px(dict(enumerate(cameras())), POINTS)


def test_a_step_moves_the_image_by_about_the_rate() -> None:
    for axis in range(6):
        found = poses()
        for view, camera in enumerate(cameras()):
            found.step(view, camera, np.eye(6)[axis], 0.5)
        if axis == 2:
            continue  # a turn about the viewing axis moves the middle of an image nowhere
        assert 0.0 < np.max(shifts(found)) < 1.0
    found = poses()
    found.step(3, cameras()[3], np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]), 0.5)
    assert shifts(found)[3] == pytest.approx(0.5, rel=0.15)
    assert shifts(found)[[0, 1, 2, 4, 5, 6, 7]].max() == 0.0
    turn = found.refined[3][:, :3]
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-12)


def test_steps_lead_downhill() -> None:
    found, camera = poses(), cameras()[4]
    aim = camera.cam_from_world[:, 3] + [0.004, -0.002, 0.003]
    for iteration in range(200):
        gradient = np.zeros(6)
        gradient[3:] = found.refined[4][:, 3] - aim
        found.step(4, camera, gradient, pose_rate_px(iteration, 200, 1))
    assert np.linalg.norm(found.refined[4][:, 3] - aim) < 2e-4


@pytest.mark.parametrize("size", [1e-4, 1e-2])
def test_what_all_cameras_share_is_taken_out(size: float) -> None:
    """To first order: the rest of a common motion is of second order."""
    found = poses()
    turn = Rotation.from_rotvec(size * np.array([0.5, -0.7, 0.4])).as_matrix()
    for view, camera in enumerate(cameras()):
        center = (1.0 + size) * turn @ camera.center + size * np.array([1.0, 2.0, -1.0])
        rotation = camera.rotation @ turn.T
        found.refined[view] = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
    before = np.abs(found.refined - found.given)[1:].max()
    found.anchor()
    assert np.abs(found.refined - found.given)[1:].max() < 4.0 * size**2 + 1e-12 < before
    assert (found.refined[0] != found.given[0]).any()  # not a training view: left alone


@pytest.mark.parametrize("axis", range(6))
def test_what_all_cameras_do_alike_in_their_own_frames_is_taken_out(axis: int) -> None:
    found, motion = poses(), 1e-3 * np.eye(6)[axis]
    turn = Rotation.from_rotvec(motion[:3]).as_matrix()
    for view in found.trained:
        found.refined[view] = turn @ found.given[view]
        found.refined[view, :, 3] += motion[3:]
    before = shifts(found)[1:]
    for _ in range(6):  # one after each epoch; what is shared in the world goes first
        found.anchor()
    assert shifts(found)[1:].max() < 0.1 * before.max()


def test_what_is_each_cameras_own_stays() -> None:
    found, random = poses(), np.random.default_rng(2)
    for view in found.trained:
        found.refined[view, :, 3] += 0.01 * random.normal(size=3)
    own = shifts(found)
    found.anchor()
    assert shifts(found)[1:].mean() > 0.5 * own[1:].mean()


def test_given_poses_come_back() -> None:
    found = poses()
    found.step(2, cameras()[2], np.ones(6), 0.5)
    assert found.moved() is not None
    found.give_up()
    found.step(2, cameras()[2], np.ones(6), 0.5)
    found.anchor()
    assert found.moved() is None
    assert shifts(found).max() == 0.0
    assert found.camera(2, cameras()[2]).cam_from_world == pytest.approx(found.given[2], abs=0)


def test_few_photos_stay_where_they_are() -> None:
    found = poses(range(LEAST_VIEWS - 1))
    found.step(1, cameras()[1], np.ones(6), 0.5)
    assert found.moved() is None
    assert poses(range(LEAST_VIEWS)).active


def test_rates_fall_and_suit_the_number_of_turns() -> None:
    assert pose_rate_px(0, 1600, 32) == pytest.approx(TRAVEL_PX / 50)
    assert pose_rate_px(1600, 1600, 32) == pytest.approx(LAST_SHARE * TRAVEL_PX / 50)
    assert pose_rate_px(5000, 1600, 32) == pose_rate_px(1600, 1600, 32)
    assert pose_rate_px(0, 1000, 1000) == LARGEST_RATE_PX
    assert pose_rate_px(0, 100_000, 10) == SMALLEST_RATE_PX


def test_stored_poses_go_on_alike() -> None:
    found = poses()
    found.step(5, cameras()[5], np.arange(6.0), 0.3)
    again = CameraPoses.restore(found.to_arrays())
    for each in (found, again):
        each.step(5, cameras()[5], np.array([1.0, -1, 0, 2, 0, 1]), 0.2)
        each.anchor()
    for name, values in found.to_arrays().items():
        assert np.array_equal(values, again.to_arrays()[name]), name
    arrays = found.to_arrays()
    with pytest.raises(ValueError, match="refined"):
        CameraPoses.restore({**arrays, "refined": arrays["refined"][:3]})


def test_photos_have_the_cameras_of_the_poses_at_every_size() -> None:
    scene, photos = sphere_scene()
    posed = PosedPhotos(photos)
    assert posed.camera(3, 2) == photos.camera(3, 2)
    posed.poses = CameraPoses(
        np.array([view.camera.cam_from_world for view in scene.views]), range(len(scene.views))
    )
    assert posed.camera(3, 2) is not None
    posed.poses.step(3, photos.camera(3), np.ones(6), 0.5)
    moved = posed.camera(3, 2)
    assert np.array_equal(moved.cam_from_world, posed.poses.refined[3])
    given = photos.camera(3, 2)
    assert dataclasses.replace(moved, cam_from_world=given.cam_from_world) == given
    assert np.array_equal(posed.photo(3, 2), photos.photo(3, 2))
