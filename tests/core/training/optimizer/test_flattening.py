# SPDX-License-Identifier: GPL-3.0-or-later
"""Decay of the smallest scale: which axis, how far, and where it ends."""

from __future__ import annotations

import math

import numpy as np

from gaussian_wrapping_addon.core.training.optimizer.flattening import (
    DISC_SHARE,
    FILTER_SHARE,
    LEAST_WIDTH,
    MOST_FLAT,
    flatten,
)

STEP = 0.01


def scales(count: int = 500) -> np.ndarray:
    return np.random.default_rng(0).uniform(-4.0, 1.0, (count, 3)).astype(np.float32)


def test_the_smallest_scale_of_discs_falls_by_the_step_and_all_else_stays() -> None:
    before = scales()
    after = before.copy()
    flatten(after, np.zeros(len(before), np.float32), STEP, threads=1)
    order = np.argsort(before, axis=1)
    least, middle, most = (np.take_along_axis(before, order[:, [k]], 1)[:, 0] for k in range(3))
    floor = middle + math.log(MOST_FLAT)
    disc = middle >= most + math.log(DISC_SHARE)
    assert 0.2 < disc.mean() < 0.8
    expected = before.copy()
    falls = np.where(disc & (least > floor), np.maximum(least - STEP, floor), least)
    np.put_along_axis(expected, order[:, :1], falls[:, None].astype(np.float32), 1)
    np.testing.assert_allclose(after, expected, atol=1e-6)


def test_it_ends_at_the_flattest_and_at_the_filter() -> None:
    log_scales = np.zeros((4, 3), np.float32)
    log_scales[2, 1] = -20.0  # flatter than the limit: it stays
    narrow = 1.01 / LEAST_WIDTH
    filter_3d = np.array([0.0, 0.1, 0.0, narrow], np.float32)
    for _ in range(2000):
        flatten(log_scales, filter_3d, STEP, threads=1)
    np.testing.assert_allclose(np.exp(log_scales[0].min()), MOST_FLAT, rtol=1e-4)
    np.testing.assert_allclose(np.exp(log_scales[1].min()), 0.1 * FILTER_SHARE, rtol=1e-4)
    assert log_scales[2, 1] == np.float32(-20.0)
    assert (log_scales[3] == 0.0).all()


def test_threads_do_not_change_the_result() -> None:
    one, two = scales(), scales()
    filter_3d = np.full(len(one), 0.01, np.float32)
    flatten(one, filter_3d, STEP, threads=1)
    flatten(two, filter_3d, STEP, threads=2)
    assert np.array_equal(one, two)
