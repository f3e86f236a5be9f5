# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera poses: gradients, steps, decisions, and trainings that refine them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import (
    ImageGradients,
    RenderOptions,
    VisibleGradients,
)
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.scene.scene import Scene, with_poses
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.camera_poses import (
    LARGEST_RATE_PX,
    LAST_SHARE,
    LEAST_VIEWS,
    SMALLEST_RATE_PX,
    TRAVEL_PX,
    CameraPoses,
    PosedPhotos,
    pose_gradient,
    pose_rate_px,
)
from gaussian_wrapping_addon.core.training.model_selection import (
    LEAST_SHIFT_PX,
    Decision,
    ModelSelection,
    select_poses,
    start_poses,
)
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.training.small_scene import (
    PhotosInMemory,
    ring_cameras,
    sphere_gaussians,
    sphere_scene,
)
from tests.core.training.test_trainer import StopAt, assert_same

# -- Refined poses: steps, what cameras share, giving up, storage ---------------------------------

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


# -- Gradient with respect to a camera's pose: its algebra exactly, and against renderings --------

OPTIONS = RenderOptions(depth=False, threads=1)


def times(rotation: Rotation, quats: np.ndarray) -> np.ndarray:
    """Return (n, 4) quaternions (w, x, y, z) turned by a rotation; lengths stay."""
    x, y, z, w = rotation.as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return quats @ left.T


def test_motion_of_a_camera_is_that_of_all_gaussians_the_other_way() -> None:
    """A loss that is linear in means and quaternions: differences are exact."""
    random = np.random.default_rng(5)
    means, quats = (random.normal(size=(40, k)).astype(np.float32) for k in (3, 4))
    ids = np.sort(random.choice(40, 25, replace=False)).astype(np.int32)
    by_means, by_quats = (random.normal(size=(25, k)).astype(np.float32) for k in (3, 4))
    nothing = np.zeros((25, 4), np.float32)
    seen = VisibleGradients(
        ids, by_means, nothing[:, :3], by_quats, nothing[:, 0], nothing[:, None, :3], nothing
    )
    turn = Rotation.from_rotvec([0.3, -0.8, 0.4])
    pose = np.concatenate([turn.as_matrix(), [[0.2], [-0.5], [3.0]]], 1)

    def value(motion: np.ndarray) -> float:
        step = Rotation.from_rotvec(motion[:3])
        local = means[ids] @ pose[:, :3].T + pose[:, 3]
        local = step.apply(local) + motion[3:]
        world = (local - pose[:, 3]) @ pose[:, :3]
        turned = times(turn.inv() * step * turn, quats[ids].astype(np.float64))
        return float((by_means * world).sum() + (by_quats * turned).sum())

    found = pose_gradient(pose, seen, means, quats)
    slopes = [(value(1e-6 * axis) - value(-1e-6 * axis)) / 2e-6 for axis in np.eye(6)]
    assert found == pytest.approx(slopes, rel=1e-5, abs=1e-5)


def moved(camera: Camera, motion: np.ndarray) -> Camera:
    pose = Rotation.from_rotvec(motion[:3]).as_matrix() @ camera.cam_from_world
    pose[:, 3] += motion[3:]
    return dataclasses.replace(camera, cam_from_world=pose)


@pytest.mark.parametrize("view", [0, 3])
def test_gradient_is_that_of_the_rendering(view: int) -> None:
    """But for what enters and leaves footprints at their edges, which gradients do not see."""
    gaussians = RawArrays.from_gaussians(sphere_gaussians(400, opacity=0.7))
    camera, renderer = ring_cameras(5, 64)[view], ViewRenderer()
    rows, columns = np.mgrid[:64, :64] / 64.0
    weights = np.stack([np.sin(9 * rows), np.cos(7 * columns), rows * columns], 2)
    weights = weights.astype(np.float32)

    def value(motion: np.ndarray) -> float:
        color = renderer.render(gaussians, moved(camera, motion), OPTIONS).color
        return float((weights.astype(np.float64) * color).sum())

    seen = renderer.render(gaussians, camera, OPTIONS).backward(ImageGradients(color=weights))
    found = pose_gradient(camera.cam_from_world, seen, gaussians.means, gaussians.quats)
    slopes = np.array([(value(2e-3 * axis) - value(-2e-3 * axis)) / 4e-3 for axis in np.eye(6)])
    assert np.linalg.norm(found[:3] - slopes[:3]) < 0.06 * np.linalg.norm(slopes[:3])
    assert np.linalg.norm(found[3:] - slopes[3:]) < 0.1 * np.linalg.norm(slopes[3:])


# -- Training on cameras that are a pixel off brings them back ------------------------------------

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


# -- Whether camera poses are refined: what starts it, what ends it -------------------------------

DENSE = ModelSelection((Decision("dense_start", "auto", "on", "found"),))
SPARSE = ModelSelection((Decision("dense_start", "auto", "off", "not found"),))


@pytest.mark.parametrize(
    ("setting", "known", "views", "chosen"),
    [
        ("auto", DENSE, 12, None),
        ("auto", SPARSE, 12, "off"),
        ("auto", DENSE, LEAST_VIEWS - 1, "off"),
        ("on", SPARSE, 12, "on"),
        ("on", DENSE, LEAST_VIEWS - 1, "off"),
        ("off", DENSE, 12, "off"),
    ],
)
def test_settings_and_start_decide_whether_poses_may_move(
    setting: str, known: ModelSelection, views: int, chosen: str | None
) -> None:
    scene, _ = sphere_scene()
    poses, selection = start_poses(setting, scene, range(views), known)
    decision = selection.get("refine_poses")
    assert (None if decision is None else decision.chosen) == chosen
    assert (poses is None) == (chosen == "off")


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_poses_that_hardly_moved_go_back(share: float) -> None:
    scene, photos = sphere_scene(size_px=32)
    poses, _ = start_poses("auto", scene, range(12), DENSE)
    assert poses is not None
    cameras = {view: photos.camera(view) for view in range(12)}
    for view, camera in cameras.items():
        gradient = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        poses.step(view, camera, gradient, share * LEAST_SHIFT_PX)
    measured = float(np.median(poses.shifts_px(cameras, POINTS)))
    assert measured == pytest.approx(share * LEAST_SHIFT_PX, rel=0.08)
    decision = select_poses(poses, cameras, POINTS)
    assert decision.chosen == ("on" if share > 1.0 else "off")
    assert decision.figures["shift_px"] == pytest.approx(measured)
    assert (poses.moved() is None) == (share < 1.0)
