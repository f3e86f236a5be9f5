# SPDX-License-Identifier: GPL-3.0-or-later
"""Motion between small pictures: exact shifts, noise, a part that moves, cuts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from gaussian_wrapping_addon.core.photos.video_frames import MotionMeter, displacement_px

SHAPE = (90, 160)


def textured(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=SHAPE)
    smooth = gaussian_filter(noise, 1.5)
    return np.asarray(128 + 40 * smooth / smooth.std(), np.float32)


@pytest.mark.parametrize("way", [(0.0, 0.6), (0.7, -1.3), (2.5, 4.5), (-6.0, 11.0), (0.0, 21.0)])
def test_shifts_are_measured(way: tuple[float, float]) -> None:
    first = textured()
    second = shift(first, way, order=3, mode="wrap").astype(np.float32)
    assert displacement_px(first, second) == pytest.approx(np.hypot(*way), abs=0.12)


def test_noise_is_no_motion() -> None:
    random, still = np.random.default_rng(1), textured()
    meter = MotionMeter()
    ways = [meter.add(still + random.normal(scale=0.5, size=SHAPE)) for _ in range(60)]
    assert ways == [0.0] * 60


def test_slow_motion_adds_up() -> None:
    first, meter = textured(), MotionMeter()
    ways = [meter.add(shift(first, (0, 0.2 * i), order=3, mode="wrap")) for i in range(101)]
    assert np.all(np.diff(ways) >= 0.0)
    # Twenty pixels; each new anchor costs what noise may be.
    assert ways[-1] * SHAPE[1] == pytest.approx(20.0, abs=1.5)


def test_what_turns_before_a_still_background_counts() -> None:
    first = textured()
    second = first.copy()
    second[30:70, 50:110] = shift(first, (0, 2.0), order=3, mode="wrap")[30:70, 50:110]
    assert displacement_px(first, second) == pytest.approx(2.0, abs=0.4)


def test_a_cut_counts_for_a_bounded_step() -> None:
    meter = MotionMeter()
    meter.add(textured(0))
    assert 0.0 < meter.add(textured(5)) <= 0.25


def test_a_picture_of_one_colour_does_not_move() -> None:
    plain = np.full(SHAPE, 50.0, np.float32)
    assert displacement_px(plain, plain) == 0.0
    assert displacement_px(np.zeros((8, 9), np.float32), np.zeros((8, 9), np.float32)) == 0.0
