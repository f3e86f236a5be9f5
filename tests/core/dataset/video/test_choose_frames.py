# SPDX-License-Identifier: GPL-3.0-or-later
"""Which frames are chosen: none that is blurred, by motion and not by time, one of each place."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.photos.video_frames import (
    FEWEST_FRAMES,
    MOST_FRAMES,
    FrameMeasures,
    automatic_count,
    choose_frames,
)

FPS = 30.0


def measures(ways: np.ndarray, blurred: np.ndarray | None = None) -> FrameMeasures:
    """Return measures of frames that are alike, with little fine detail where blurred."""
    count = len(ways)
    details = np.zeros((count, 2, 4))
    details += 0.02 * np.random.default_rng(0).normal(size=(count, 1, 1))
    if blurred is not None:
        details[blurred, 0, 1] -= 2.0
    return FrameMeasures(np.arange(count), np.arange(count) / FPS, np.asarray(ways), details)


def test_no_blurred_frame_is_chosen_and_they_are_counted() -> None:
    blurred = np.random.default_rng(1).random(600) < 1 / 3
    choice = choose_frames(measures(np.linspace(0.0, 5.0, 600), blurred))
    assert len(choice.positions) >= 55
    assert not blurred[choice.positions].any()
    assert choice.blurred == blurred.sum()
    assert choice.gaps_s == ()


def test_a_pause_gives_one_frame_at_most() -> None:
    ways = np.concatenate([np.linspace(0, 2, 100), np.full(300, 2.0), np.linspace(2, 4, 100)])
    choice = choose_frames(measures(ways))
    paused = (choice.positions >= 99) & (choice.positions <= 400)
    assert paused.sum() <= 1
    assert len(choice.positions) == pytest.approx(50, abs=2)
    assert choice.still >= 298


def test_fast_motion_gives_more_frames() -> None:
    ways = np.concatenate([np.linspace(0, 1, 300), np.linspace(1, 4, 300)[1:]])
    chosen = choose_frames(measures(ways)).positions
    assert (chosen >= 300).sum() == pytest.approx(3 * (chosen < 300).sum(), rel=0.15)


@pytest.mark.parametrize("wanted", [3, 20, 77])
def test_a_wanted_number_is_given(wanted: int) -> None:
    choice = choose_frames(measures(np.linspace(0.0, 4.0, 600)), frames=wanted)
    assert len(choice.positions) == wanted
    assert np.all(np.diff(choice.positions) > 0)
    steps = np.diff(choice.positions)
    assert steps.max() < 2.0 * 600 / wanted


def test_frames_a_second_count_by_time() -> None:
    ways = np.concatenate([np.linspace(0, 1, 300), np.linspace(1, 4, 301)[1:]])
    chosen = choose_frames(measures(ways), fps=3.0).positions
    assert len(chosen) == 60
    assert (chosen < 300).sum() == 30
    assert len(choose_frames(measures(ways), frames=10, fps=3.0).positions) == 10


def test_nothing_moves_gives_one_frame() -> None:
    choice = choose_frames(measures(np.zeros(90)))
    assert len(choice.positions) == 1
    assert choice.still == 89
    assert len(choose_frames(measures(np.zeros(90)), fps=10.0).positions) == 1


def test_blur_over_a_long_way_is_reported() -> None:
    blurred = (np.arange(600) >= 200) & (np.arange(600) < 300)
    choice = choose_frames(measures(np.linspace(0.0, 5.0, 600), blurred))
    ((begin, end),) = choice.gaps_s
    assert begin == pytest.approx(200 / FPS, abs=0.3)
    assert end == pytest.approx(300 / FPS, abs=0.3)


def test_all_blurred_and_empty() -> None:
    nothing = FrameMeasures(np.zeros(0, int), np.zeros(0), np.zeros(0), np.zeros((0, 2, 4)))
    assert len(choose_frames(nothing).positions) == 0


def test_the_automatic_number_follows_the_motion() -> None:
    assert automatic_count(0.0) == FEWEST_FRAMES
    assert automatic_count(8.0) == 100
    assert automatic_count(1e6) == MOST_FRAMES
