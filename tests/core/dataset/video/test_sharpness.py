# SPDX-License-Identifier: GPL-3.0-or-later
"""Sharpness: blur in any direction is found, changing content and noise are not taken for it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter1d

from gaussian_wrapping_addon.core.photos.video_frames import (
    are_blurred,
    details,
    relative_sharpness,
)
from tests.core.dataset.video.small_videos import mural

SHAPE = (240, 320)


def greys(count: int, *, noise: float = 1.0) -> list[np.ndarray]:
    wide, random = mural().mean(2), np.random.default_rng(3)
    return [
        (wide[: SHAPE[0], 8 * i : 8 * i + SHAPE[1]] + random.normal(scale=noise, size=SHAPE))
        for i in range(count)
    ]


def judged(frames: list[np.ndarray], step: float = 0.02) -> np.ndarray:
    found = np.stack([details(np.asarray(frame, np.float32)) for frame in frames])
    times = np.arange(len(frames)) / 30.0
    return are_blurred(found, relative_sharpness(found, times, step * np.arange(len(frames))))


@pytest.mark.parametrize("noise", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_blur_of_one_direction_is_found(axis: int, noise: float) -> None:
    frames, random = greys(60, noise=0.0), np.random.default_rng(4)
    truth = np.arange(60) % 3 == 1
    for i in np.flatnonzero(truth):
        frames[i] = uniform_filter1d(frames[i], 7, axis=axis)
    frames = [frame + random.normal(scale=noise, size=SHAPE) for frame in frames]
    assert np.array_equal(judged(frames), truth)


def test_frames_without_blur_are_all_sharp_whatever_they_show() -> None:
    frames = greys(40)
    for i in range(15, 25):  # a plain wall comes into the picture, and goes
        frames[i][:, : 25 * (10 - abs(i - 20))] = 128.0
    assert not judged(frames, step=0.1)[:15].any()
    assert not judged(frames, step=0.1)[25:].any()
    assert judged(frames, step=0.1).sum() <= 2


def test_long_blur_is_found_although_no_frame_near_it_is_sharp() -> None:
    frames = greys(60)
    truth = (np.arange(60) >= 20) & (np.arange(60) < 40)
    for i in np.flatnonzero(truth):
        frames[i] = gaussian_filter(frames[i], 3.0)
    # So much motion from frame to frame that none is compared with its neighbours.
    assert np.array_equal(judged(frames, step=1.0), truth)


def test_black_frames_are_no_failure() -> None:
    found = details(np.zeros(SHAPE, np.float32))
    assert np.isfinite(found).all()
    assert found.shape == (2, 4)
