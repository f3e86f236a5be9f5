# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames: the up direction, the ground, the scene frame, similarities, the grid."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import DatasetError, UsageError
from gaussian_wrapping_addon.core.limits import SCENE_RADIUS
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.frames import (
    CENTER_STEP,
    FRAME_STEP,
    LENGTH_BITS,
    ROTATION_STEP,
    SceneFrame,
    camera_up,
    find_ground_plane,
    find_scene_frame,
    snapped,
    snapped_camera,
    snapped_length,
    snapped_rotation,
)
from gaussian_wrapping_addon.core.scene.placement import umeyama, umeyama_ransac
from tests.core.readers.model_writers import ring_poses
from tests.poses import look_at_pose

UP = np.array([0.0, 0.0, 1.0])


def rolled(rotation: np.ndarray, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotation


def orbit(
    rolls_deg: np.ndarray | float,
    *,
    sweep: float = 2 * np.pi,
    height: float = 1.5,
    noise: float = 3,
) -> tuple[np.ndarray, np.ndarray]:
    """Hand-held cameras on an arc, each rolled by its own angle plus the hand's."""
    rolls = np.broadcast_to(rolls_deg, 24 if np.ndim(rolls_deg) == 0 else len(rolls_deg))
    random = np.random.default_rng(2)
    rotations, centers = [], []
    for angle, roll in zip(np.linspace(0, sweep, len(rolls), False), rolls, strict=True):
        center = np.array([3 * np.cos(angle), 3 * np.sin(angle), height])
        center = center + 0.1 * random.normal(size=3)
        rotations.append(rolled(look_at_pose(center)[:, :3], roll + noise * random.normal()))
        centers.append(center)
    return np.array(rotations), np.array(centers)


def off_deg(up: np.ndarray, expected: np.ndarray = UP) -> float:
    assert np.linalg.norm(up) == pytest.approx(1.0, abs=1e-12)
    return float(np.degrees(np.arccos(np.clip(up @ expected, -1, 1))))


MIXED = np.array(
    [0, 90, 0, 0, 270, 90, 0, 0, 90, 0, 90, 0, 0, 90, 0, 270, 0, 0, 90, 0, 0, 90, 0, 0]
)
QUARTERS = np.where(np.arange(24) % 2, 90.0, 270.0)
SOME_DOWN = np.where(np.arange(24) % 6 == 0, 180.0, 0.0)


@pytest.mark.parametrize("rolls", [0.0, 90.0, 270.0, MIXED, np.roll(MIXED, 5), QUARTERS, SOME_DOWN])
@pytest.mark.parametrize("sweep", [2 * np.pi, 2.0])
def test_up_of_hand_held_cameras(rolls: np.ndarray | float, sweep: float) -> None:
    assert off_deg(camera_up(*orbit(rolls, sweep=sweep))[0]) < 4.0


@pytest.mark.parametrize("rolls", [0.0, 90.0, MIXED])
def test_exact_where_hands_are_steady(rolls: np.ndarray | float) -> None:
    assert off_deg(camera_up(*orbit(rolls, noise=0.0))[0]) < 1e-4


@pytest.mark.parametrize("rolls", [0.0, MIXED])
@pytest.mark.parametrize(("scale", "away"), [(1e-3, 0.0), (1e4, 0.0), (1.0, 4e6)])
def test_up_turns_with_the_scene(rolls: np.ndarray | float, scale: float, away: float) -> None:
    rotations, centers = orbit(rolls)
    base, rule = camera_up(rotations, centers)
    q = Rotation.random(random_state=8).as_matrix()
    up, same_rule = camera_up(rotations @ q.T, scale * centers @ q.T + away)
    assert same_rule == rule
    assert off_deg(up, q @ base) < 1e-3


def test_all_upside_down_is_taken_for_upright_cameras() -> None:
    """From cameras alone, an upside-down world is as good: the sign is theirs."""
    assert off_deg(camera_up(*orbit(180.0))[0], -UP) < 4.0


@pytest.mark.parametrize("height", [1.5, -1.5])
def test_quarter_turns_take_the_sign_of_the_look(height: float) -> None:
    up, rule = camera_up(*orbit(90.0, height=height))
    assert rule == "cameras turned by quarters"
    # Things stand below the cameras: looking up is taken for looking down.
    assert off_deg(up, np.sign(height) * UP) < 4.0


def test_one_camera_and_two_that_face_each_other_have_their_own_up() -> None:
    rotations = np.array([look_at_pose([x, 0, 0])[:, :3] for x in (3.0, -3.0)])
    centers = np.array([[3.0, 0, 0], [-3.0, 0, 0]])
    for count in (1, 2):
        assert off_deg(camera_up(rotations[:count], centers[:count])[0]) < 1e-6


def opposite() -> tuple[np.ndarray, np.ndarray]:
    first = look_at_pose([3.0, 0, 0])[:, :3]
    second = rolled(look_at_pose([-3.0, 0, 0])[:, :3], 180.0)
    return np.array([first, second]), np.array([[3.0, 0, 0], [-3.0, 0, 0]])


@pytest.mark.parametrize(
    "cameras",
    [
        (np.zeros((0, 3, 3)), np.zeros((0, 3))),
        (
            Rotation.random(40, random_state=11).as_matrix(),
            np.random.default_rng(1).normal(size=(40, 3)),
        ),
        opposite(),
        orbit(90.0, height=0.0, noise=0.0),
        (np.full((3, 3, 3), np.nan), np.zeros((3, 3))),
    ],
    ids=["none", "random", "opposite", "no side", "not finite"],
)
def test_where_nobody_can_tell_the_next_step_is_named(
    cameras: tuple[np.ndarray, np.ndarray],
) -> None:
    with pytest.raises(UsageError) as caught:
        camera_up(*cameras)
    assert caught.value.hint


Faces = tuple[np.ndarray, np.ndarray, np.ndarray]


def sheet(height: float, half: float, normal: tuple[float, float, float], count: int = 40) -> Faces:
    """A square of level faces."""
    line = (np.arange(count) + 0.5) / count * 2 * half - half
    x, y = (g.ravel() for g in np.meshgrid(line, line))
    centers = np.stack([x, y, np.full(len(x), height)], 1)
    return centers, np.tile(normal, (len(x), 1)), np.full(len(x), (2 * half / count) ** 2)


def ball(radius: float, height: float, count: int = 2000) -> Faces:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    areas = np.full(count, 4 * np.pi * radius**2 / count)
    return radius * normals + [0, 0, height], normals, areas


def together(*parts: Faces) -> Faces:
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))  # type: ignore[return-value]


def table() -> Faces:
    """A ball above a slab: its top at 0 is the ground, its bottom faces down."""
    return together(sheet(0.0, 2.0, (0, 0, 1)), sheet(-0.3, 2.0, (0, 0, -1)), ball(0.6, 0.7))


def tilt(faces: Faces, degrees: float) -> tuple[Faces, np.ndarray]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return (faces[0] @ rotation.T, faces[1] @ rotation.T, faces[2]), rotation @ UP


@pytest.mark.parametrize("degrees", [0.0, -6.0])
@pytest.mark.parametrize(("scale", "away"), [(1e-3, 0.0), (1e4, 0.0), (1.0, 1e3)])
def test_a_table_is_found_and_levelled(degrees: float, scale: float, away: float) -> None:
    (centers, normals, areas), true_up = tilt(table(), degrees)
    plane = find_ground_plane(scale * centers + away, normals, scale**2 * areas, UP)
    assert plane is not None
    assert np.degrees(np.arccos(min(plane.normal @ true_up, 1.0))) < 0.2
    assert abs((plane.point - away) @ true_up) < 2e-3 * scale


def test_a_rough_ground_is_found_within_its_noise() -> None:
    centers, normals, areas = table()
    centers = centers + 0.01 * np.random.default_rng(1).normal(size=centers.shape)
    plane = find_ground_plane(centers, normals, areas, UP)
    assert plane is not None
    assert abs(plane.point[2]) < 2e-3
    assert plane.normal[2] > np.cos(np.radians(0.5))


def test_the_cap_of_a_region_that_cuts_through_does_not_count() -> None:
    plane = find_ground_plane(*together(table(), sheet(1.4, 6.0, (0, 0, 1))), UP)
    assert plane is not None
    assert abs(plane.point[2]) < 1e-3


TOP = sheet(0.5, 0.5, (0, 0, 1))


@pytest.mark.parametrize(
    "faces",
    [
        ball(1.0, 0.0),
        together(TOP, (-TOP[0], -TOP[1], TOP[2])),
        together(*[sheet(0.2 * k, 1.0, (0, 0, 1), 20) for k in range(5)]),
        sheet(0.0, 1.0, (0, 0, -1)),
        (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)),
        (np.zeros((5, 3)), np.tile(UP, (5, 1)), np.ones(5)),
        (np.full((5, 3), np.nan), np.tile(UP, (5, 1)), np.ones(5)),
    ],
    ids=["ball", "top of a cube", "shelves", "ceiling", "nothing", "one point", "nan"],
)
def test_no_plane_where_none_is_clear(faces: Faces) -> None:
    assert find_ground_plane(*faces, UP) is None


def frame_of(poses: list[np.ndarray]) -> tuple[SceneFrame, np.ndarray]:
    rotations = np.array([pose[:, :3] for pose in poses])
    centers = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
    return find_scene_frame(rotations, centers), centers


def moved(pose: np.ndarray, new_from_old: Similarity) -> np.ndarray:
    rotation = pose[:, :3] @ new_from_old.rotation.T
    center = new_from_old.points((-pose[:, :3].T @ pose[:, 3])[None])[0]
    return np.concatenate([rotation, -(rotation @ center)[:, None]], 1)


def wobbly_arc(count: int = 24, sweep: float = 2.0) -> list[np.ndarray]:
    """Poses of a hand-held camera over part of a circle, looking down and not quite level."""
    rng = np.random.default_rng(1)
    poses = []
    for angle in np.linspace(0, sweep, count):
        center = np.array([3 * np.cos(angle), 3 * np.sin(angle), 2.0]) + 0.05 * rng.normal(size=3)
        poses.append(rolled(look_at_pose(center), np.degrees(0.03 * rng.normal())))
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


@pytest.mark.parametrize("scale", [1e-3, 1e4])
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (5e5, 4e6, 0.0)])
def test_same_frame_for_any_similarity_of_the_input(
    scale: float, offset: tuple[float, float, float]
) -> None:
    poses = wobbly_arc()
    base, centers = frame_of(poses)
    change = Similarity(scale, TURN, np.array(offset))
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
    hands = np.degrees(0.02 * np.random.default_rng(2).normal(size=16))
    rolls = np.where(np.arange(16) % 2, 45.0, -45.0) + hands
    poses = [rolled(pose, roll) for pose, roll in zip(ring_poses(16), rolls, strict=True)]
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


TURN = Rotation.random(random_state=5).as_matrix()
TRUE = Similarity(3.7, TURN, np.array([5.0, -2.0, 0.3]))


def assert_same(found: Similarity, true: Similarity, tolerance: float) -> None:
    assert abs(found.scale / true.scale - 1) < tolerance
    np.testing.assert_allclose(found.rotation, true.rotation, atol=tolerance)
    size = max(1.0, float(np.abs(true.translation).max()))
    np.testing.assert_allclose(found.translation, true.translation, atol=tolerance * size)


def test_umeyama_is_exact() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    for some in (points, corner):
        assert_same(umeyama(some, TRUE.points(some), with_scale=True), TRUE, 1e-13)
    rigid = Similarity(1.0, TRUE.rotation, TRUE.translation)
    assert_same(umeyama(points, rigid.points(points), with_scale=False), rigid, 1e-13)
    far = points + np.array([4e6, -7e6, 3e5])
    found = umeyama(far, TRUE.points(far), with_scale=True)
    # 3.7 x 7e6 has a rounding of 4e-9.
    assert np.abs(found.points(far) - TRUE.points(far)).max() < 2e-7
    np.testing.assert_allclose(found.rotation, TRUE.rotation, atol=1e-9)


def test_a_mirror_image_gets_the_best_proper_rotation() -> None:
    points = np.random.default_rng(2).normal(size=(30, 3)) * [3.0, 2.0, 0.1]
    found = umeyama(points, points * [1, 1, -1], with_scale=False)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0, abs=1e-12)
    # The thin direction cannot be mirrored, the other two are met: almost the identity.
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=0.02)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.eye(3)[:2], "2 pairs"),
        (np.outer(np.arange(5.0), [1.0, 2.0, 3.0]), "on one line"),
        (np.outer(np.arange(5.0), [1.0, 2.0, 3.0]) + 1e7, "on one line"),
        (np.ones((5, 3)), "in one place"),
        (np.full((4, 3), np.nan), "not all finite"),
    ],
)
def test_degenerate_pairs_are_refused(points: np.ndarray, words: str) -> None:
    with pytest.raises(DatasetError, match=words):
        umeyama(points, points, with_scale=True)
    with pytest.raises(DatasetError, match=words):
        umeyama_ransac(points, points, threshold=1.0, iterations=10, seed=0)


def test_ransac_survives_forty_percent_of_outliers() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(100, 3)) + np.array([1e5, 0, 0])
    target = TRUE.points(points)
    wrong = rng.permutation(100)[:40]
    target[wrong] += rng.normal(size=(40, 3)) * 5 + 3
    found, again = (
        umeyama_ransac(points, target, threshold=0.05, iterations=100_000, seed=0) for _ in range(2)
    )
    assert set(np.flatnonzero(~found.inliers)) == set(wrong)
    assert np.abs(found.transform.points(points) - TRUE.points(points)).max() < 1e-8
    assert (again.transform.matrix() == found.transform.matrix()).all()


def test_pairs_that_do_not_belong_together_are_refused() -> None:
    rng = np.random.default_rng(4)
    with pytest.raises(DatasetError, match="do not correspond"):
        umeyama_ransac(
            rng.normal(size=(20, 3)), rng.normal(size=(20, 3)) * 9,
            threshold=1e-6, iterations=500, seed=0,
        )  # fmt: skip


RANDOM = np.random.default_rng(11)


def test_noise_below_half_a_step_leaves_no_trace() -> None:
    step = CENTER_STEP
    cells = step * RANDOM.integers(-(2**20), 2**20, (1000, 3))
    noisy = cells + 0.49 * step * RANDOM.uniform(-1, 1, cells.shape)
    np.testing.assert_array_equal(snapped(noisy, step), cells)
    assert not np.signbit(snapped(np.array([-1e-9]), step)).any()


def test_a_camera_moves_by_less_than_a_step_and_stays_a_rotation() -> None:
    for rotation in Rotation.random(50, random_state=1).as_matrix():
        center = RANDOM.uniform(-5, 5, 3)
        pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
        camera = Camera("a", 80, 64, 90.0, 90.0, 40.0, 32.0, pose)
        near = snapped_camera(camera)
        np.testing.assert_allclose(near.center, center, atol=0.5 * CENTER_STEP + 1e-14)
        np.testing.assert_allclose(near.rotation, rotation, atol=4 * ROTATION_STEP)
        np.testing.assert_allclose(near.rotation @ near.rotation.T, np.eye(3), atol=1e-15)
        wobble = pose * [1.0, 1.0, 1.0, 1.0 + 2.0**-52]
        again = snapped_camera(dataclasses.replace(camera, cam_from_world=wobble))
        np.testing.assert_array_equal(again.cam_from_world, near.cam_from_world)


def test_half_turns_whose_quaternion_has_no_sign() -> None:
    for axis in np.eye(3):
        turn = 2.0 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_array_equal(snapped_rotation(turn, ROTATION_STEP), turn)


@pytest.mark.parametrize("length", [0.0, 1e-7, 37.5, 1e6])
def test_lengths_keep_their_significant_bits(length: float) -> None:
    near = snapped_length(length)
    assert abs(near - length) <= length * 2.0**-LENGTH_BITS
    assert snapped_length(near * (1 + 1e-9)) == near
    assert snapped_length(near * 1024) == near * 1024


def test_the_inverse_of_a_far_frame_keeps_the_digits_of_the_points() -> None:
    """Points given in steps of 2^-30 at UTM coordinates come back exactly, not to 1e-9."""
    origin = np.array([5e5, 4e6, 30.0])
    world_from_scene = Similarity(0.5, np.eye(3), origin)
    world = origin + 2.0**-30 * RANDOM.integers(-(2**30), 2**30, (200, 3))
    scene = world_from_scene.inverse().points(world)
    np.testing.assert_array_equal(scene, (world - origin) / 0.5)
    twice = world_from_scene.inverse().inverse()
    np.testing.assert_array_equal(twice.translation, origin)
    np.testing.assert_allclose(twice.points(scene), world, rtol=1e-15)
    assert Similarity.from_json(world_from_scene.inverse().to_json()).points(world) == (
        pytest.approx(scene, abs=1e-8)
    )
