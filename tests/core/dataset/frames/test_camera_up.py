# SPDX-License-Identifier: GPL-3.0-or-later
"""Up direction of cameras that are level, pitched, rolled, upside down, or ambiguous."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.scene.frames import camera_up
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


@pytest.mark.parametrize(
    "rolls",
    [0.0, 90.0, 270.0, MIXED, np.roll(MIXED, 5), np.where(np.arange(24) % 2, 90.0, 270.0)],
)
@pytest.mark.parametrize("sweep", [2 * np.pi, 2.0])
def test_up_of_hand_held_cameras(rolls: np.ndarray | float, sweep: float) -> None:
    up, _ = camera_up(*orbit(rolls, sweep=sweep))
    assert off_deg(up) < 4.0


@pytest.mark.parametrize("rolls", [0.0, 90.0, MIXED])
def test_exact_where_hands_are_steady(rolls: np.ndarray | float) -> None:
    up, _ = camera_up(*orbit(rolls, noise=0.0))
    assert off_deg(up) < 1e-4


@pytest.mark.parametrize("rolls", [0.0, 90.0, MIXED])
@pytest.mark.parametrize(("scale", "away"), [(1e-3, 0.0), (1e4, 0.0), (1.0, 4e6)])
def test_up_turns_with_the_scene(rolls: np.ndarray | float, scale: float, away: float) -> None:
    rotations, centers = orbit(rolls)
    base, rule = camera_up(rotations, centers)
    q, _ = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))
    q = q if np.linalg.det(q) > 0 else -q
    up, same_rule = camera_up(rotations @ q.T, scale * centers @ q.T + away)
    assert same_rule == rule
    assert off_deg(up, q @ base) < 1e-3


def test_a_few_photos_upside_down_do_not_count() -> None:
    rolls = np.where(np.arange(24) % 6 == 0, 180.0, 0.0)
    assert off_deg(camera_up(*orbit(rolls))[0]) < 4.0


def test_all_upside_down_is_taken_for_upright_cameras() -> None:
    """From cameras alone, an upside-down world is as good: the sign is theirs."""
    assert off_deg(camera_up(*orbit(180.0))[0], -UP) < 4.0


@pytest.mark.parametrize("height", [1.5, -1.5])
def test_quarter_turns_take_the_sign_of_the_look(height: float) -> None:
    up, rule = camera_up(*orbit(90.0, height=height))
    assert rule == "cameras turned by quarters"
    # Things stand below the cameras: looking up is taken for looking down.
    assert off_deg(up, np.sign(height) * UP) < 4.0


def test_one_camera_is_its_own_up() -> None:
    rotation = look_at_pose([3.0, 0.0, 0.0])[None, :, :3]
    assert off_deg(camera_up(rotation, np.array([[3.0, 0, 0]]))[0]) < 1e-6


def test_two_cameras_that_face_each_other_share_their_up() -> None:
    poses = [look_at_pose([3.0, 0, 0]), look_at_pose([-3.0, 0, 0])]
    rotations = np.array([p[:, :3] for p in poses])
    assert off_deg(camera_up(rotations, np.array([[3.0, 0, 0], [-3.0, 0, 0]]))[0]) < 1e-6


def random_rotations(count: int) -> np.ndarray:
    random = np.random.default_rng(11)
    found = []
    for _ in range(count):
        q, _ = np.linalg.qr(random.normal(size=(3, 3)))
        found.append(q if np.linalg.det(q) > 0 else -q)
    return np.array(found)


def opposite() -> tuple[np.ndarray, np.ndarray]:
    first = look_at_pose([3.0, 0, 0])[:, :3]
    second = rolled(look_at_pose([-3.0, 0, 0])[:, :3], 180.0)
    return np.array([first, second]), np.array([[3.0, 0, 0], [-3.0, 0, 0]])


@pytest.mark.parametrize(
    "cameras",
    [
        (np.zeros((0, 3, 3)), np.zeros((0, 3))),
        (random_rotations(40), np.random.default_rng(1).normal(size=(40, 3))),
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
