# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene frame: up, centre, radius; the same for any similarity of the input."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.limits import SCENE_RADIUS
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.frames import FRAME_STEP, SceneFrame, find_scene_frame
from tests.core.dataset.model_writers import ring_poses
from tests.poses import look_at_pose


def frame_of(poses: list[np.ndarray]) -> tuple[SceneFrame, np.ndarray]:
    rotations = np.array([pose[:, :3] for pose in poses])
    centers = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
    return find_scene_frame(rotations, centers), centers


def moved(pose: np.ndarray, new_from_old: Similarity) -> np.ndarray:
    rotation = pose[:, :3] @ new_from_old.rotation.T
    center = new_from_old.points((-pose[:, :3].T @ pose[:, 3])[None])[0]
    return np.concatenate([rotation, -(rotation @ center)[:, None]], 1)


def some_rotation() -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def wobbly_arc(count: int = 24, sweep: float = 2.0) -> list[np.ndarray]:
    """Poses of a hand-held camera over part of a circle, looking down and not quite level."""
    rng = np.random.default_rng(1)
    poses = []
    for angle in np.linspace(0, sweep, count):
        center = np.array([3 * np.cos(angle), 3 * np.sin(angle), 2.0]) + 0.05 * rng.normal(size=3)
        pose = look_at_pose(center, np.zeros(3))
        roll = 0.03 * rng.normal()
        c, s = np.cos(roll), np.sin(roll)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        poses.append(turn @ pose)
    return poses


def test_mean_radius_and_right_handed_up() -> None:
    frame, centers = frame_of(ring_poses(12))
    scene = frame.scene_from_world.points(centers)
    np.testing.assert_allclose(scene.mean(0), 0, atol=1e-12)
    assert np.linalg.norm(scene, axis=1).max() * 1.1 == pytest.approx(SCENE_RADIUS, rel=1e-12)
    rotation = frame.scene_from_world.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation @ [0, 0, 1], [0, 0, 1], atol=2 * FRAME_STEP)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (5e5, 4e6, 0.0)])
def test_same_frame_for_any_similarity_of_the_input(
    scale: float, offset: tuple[float, float, float]
) -> None:
    poses = wobbly_arc()
    base, centers = frame_of(poses)
    change = Similarity(scale, some_rotation(), np.array(offset))
    frame, far_centers = frame_of([moved(pose, change) for pose in poses])
    expected = base.scene_from_world.points(centers)
    # What float64 holds of the input: the offset's last digit, seen at the scene's scale.
    tolerance = 1e-9 + 50 * 2**-52 * max(offset) * frame.scene_from_world.scale
    np.testing.assert_allclose(frame.scene_from_world.points(far_centers), expected, atol=tolerance)
    back = frame.scene_from_world.inverse().points(expected)
    np.testing.assert_allclose(back, far_centers, atol=tolerance * scale + 1e-8)


def test_up_of_a_pitched_arc_is_the_true_up() -> None:
    """The mean camera up is 30 degrees off here; level cameras are exact up to their wobble."""
    poses = wobbly_arc(sweep=1.0)
    ups = np.mean([-pose[1, :3] for pose in poses], axis=0)
    assert np.degrees(np.arccos(ups[2] / np.linalg.norm(ups))) > 25
    frame, _ = frame_of(poses)
    assert frame.up_rule == "level cameras"
    up = frame.scene_from_world.rotation[2]
    assert np.degrees(np.arccos(up[2])) < 2.0


def test_portrait_cameras_fall_back_to_their_plane_path() -> None:
    """Cameras rolled by +-45 degrees have no level axis, but their path is a circle."""
    rng = np.random.default_rng(2)
    poses = []
    for i, pose in enumerate(ring_poses(16)):
        roll = np.radians(45.0 if i % 2 else -45.0) + 0.02 * rng.normal()
        c, s = np.cos(roll), np.sin(roll)
        poses.append(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ pose)
    frame, _ = frame_of(poses)
    assert frame.up_rule == "plane camera path"
    np.testing.assert_allclose(frame.scene_from_world.rotation[2], [0, 0, 1], atol=1e-6)


def test_one_camera_at_a_million_is_left_out() -> None:
    poses = ring_poses(10)
    base, _ = frame_of(poses)
    wild = [*poses, look_at_pose(np.array([1e6, 2e5, 0.0]), np.zeros(3))]
    frame, _ = frame_of(wild)
    assert frame.keep.tolist() == [True] * 10 + [False]
    assert frame.scene_from_world.scale == base.scene_from_world.scale


def test_degenerate_camera_sets() -> None:
    here = np.array([1.0, 2.0, 3.0])
    same = [look_at_pose(here, here + np.array([np.cos(a), np.sin(a), 0])) for a in range(5)]
    with pytest.raises(DatasetError, match="from one place"):
        frame_of(same)
    line = [look_at_pose(np.array([x, -5.0, 0.0]), np.array([x, 0.0, 0.0])) for x in range(5)]
    frame, _ = frame_of(line)
    assert frame.collinear
    np.testing.assert_allclose(frame.scene_from_world.rotation[2], [0, 0, 1], atol=1e-9)
