# SPDX-License-Identifier: GPL-3.0-or-later
"""The grid that scenes are rounded to: exact, idempotent, and finer than its stated bounds."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity, rotation_from_quaternion
from gaussian_wrapping_addon.core.scene.frames import (
    CENTER_STEP,
    LENGTH_BITS,
    ROTATION_STEP,
    snapped,
    snapped_camera,
    snapped_length,
    snapped_rotation,
)

RANDOM = np.random.default_rng(11)


def random_rotation() -> np.ndarray:
    rotation = rotation_from_quaternion(RANDOM.normal(size=4))
    assert rotation is not None
    return rotation


def test_noise_below_half_a_step_leaves_no_trace() -> None:
    step = CENTER_STEP
    cells = step * RANDOM.integers(-(2**20), 2**20, (1000, 3))
    noisy = cells + 0.49 * step * RANDOM.uniform(-1, 1, cells.shape)
    np.testing.assert_array_equal(snapped(noisy, step), cells)
    assert not np.signbit(snapped(np.array([-1e-9]), step)).any()


def test_a_camera_moves_by_less_than_a_step_and_stays_a_rotation() -> None:
    for _ in range(50):
        rotation, center = random_rotation(), RANDOM.uniform(-5, 5, 3)
        pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
        camera = Camera("a", 80, 64, 90.0, 90.0, 40.0, 32.0, pose)
        near = snapped_camera(camera)
        np.testing.assert_allclose(near.center, center, atol=0.5 * CENTER_STEP + 1e-14)
        np.testing.assert_allclose(near.rotation, rotation, atol=4 * ROTATION_STEP)
        np.testing.assert_allclose(near.rotation @ near.rotation.T, np.eye(3), atol=1e-15)
        wobble = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
        wobble[:, 3] *= 1.0 + 2.0**-52
        again = snapped_camera(Camera("a", 80, 64, 90.0, 90.0, 40.0, 32.0, wobble))
        np.testing.assert_array_equal(again.cam_from_world, near.cam_from_world)


def test_half_turns_whose_quaternion_has_no_sign() -> None:
    for axis in np.eye(3):
        turn = 2.0 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_array_equal(snapped_rotation(turn, ROTATION_STEP), turn)


@pytest.mark.parametrize("length", [0.0, 1e-7, 0.013, 1.0, 37.5, 1e6])
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
