# SPDX-License-Identifier: GPL-3.0-or-later
"""Loss on depths that leave those that stereo confirmed: values, gradient, what does not count."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthPrior
from gaussian_wrapping_addon.core.training.backend import Window
from gaussian_wrapping_addon.core.training.losses import (
    OUTLIER_SHARE,
    TOLERANCE_SHARE,
    depth_prior_loss,
)
from tests.core.render.scenes import look_at

WEIGHT = 0.3


def prior_of(camera: Camera, seed: int = 0) -> DepthPrior:
    """Return random depths around 2, a few of them unconfirmed."""
    random = np.random.default_rng(seed)
    shape = (camera.height, camera.width)
    depth = random.uniform(1.5, 2.5, shape).astype(np.float32)
    confidence = random.uniform(0.1, 1.0, shape).astype(np.float32)
    depth[random.random(shape) < 0.2] = 0.0
    return DepthPrior(camera, depth, confidence, depth, np.zeros_like(depth))


def camera() -> Camera:
    return look_at((0.0, -2.0, 1.0), width=24, height=16, focal=20.0)


def test_the_gradient_is_that_of_the_loss() -> None:
    prior, random = prior_of(camera()), np.random.default_rng(1)
    # Away from the kinks of the loss at both limits.
    off = random.choice([-2.4, -1.5, -0.6, 0.3, 0.8, 2.2], prior.depth.shape) * TOLERANCE_SHARE
    depth = prior.depth.astype(np.float64) * (1.0 + off)
    _, found = depth_prior_loss(depth, camera(), prior, weight=WEIGHT)
    assert found.depth is not None
    for row, column in random.integers(0, depth.shape, (40, 2)):
        values = []
        for step in (-1e-6, 1e-6):
            moved = depth.copy()
            moved[row, column] += step
            values.append(depth_prior_loss(moved, camera(), prior, weight=WEIGHT)[0])
        numeric = (values[1] - values[0]) / 2e-6
        assert found.depth[row, column] == pytest.approx(numeric, rel=1e-5, abs=1e-9)


def test_values_are_those_of_the_formula() -> None:
    prior = prior_of(camera())
    known = prior.depth > 0
    for off, height in ((0.5, 0.125), (1.0, 0.5), (2.0, 1.5), (-2.0, 1.5)):
        depth = prior.depth.astype(np.float64) * (1.0 + off * TOLERANCE_SHARE)
        value, _ = depth_prior_loss(depth, camera(), prior, weight=WEIGHT)
        expected = WEIGHT * height * prior.confidence[known].sum() / depth.size
        assert value == pytest.approx(expected, rel=1e-5)


def test_outliers_masked_pixels_and_missing_depths_do_not_count() -> None:
    prior = prior_of(camera())
    far = prior.depth * np.float32(1.0 + 1.01 * OUTLIER_SHARE)
    near = prior.depth * np.float32(1.0 + 0.5 * OUTLIER_SHARE)
    nothing = np.zeros_like(near)
    for depth, mask in ((far, None), (nothing, None), (near, np.zeros(near.shape, bool))):
        value, found = depth_prior_loss(depth, camera(), prior, mask, weight=WEIGHT)
        assert value == 0.0
        assert found.depth is not None
        assert not found.depth.any()
    assert depth_prior_loss(near, camera(), prior, weight=WEIGHT)[0] > 0.0


@pytest.mark.parametrize("scale", [1, 2])
def test_windows_of_any_size_read_the_prior_of_their_place(scale: int) -> None:
    whole = camera().resized(24 * scale, 16 * scale)
    prior = prior_of(camera())
    depth = np.repeat(np.repeat(prior.depth, scale, 0), scale, 1)
    window = Window(8 * scale, 4 * scale, 10 * scale, 8 * scale)
    part = np.ascontiguousarray(window.of(depth))
    value, found = depth_prior_loss(part, window.camera(whole), prior, weight=WEIGHT)
    assert part.any()
    assert value == 0.0
    assert found.depth is not None
    assert not found.depth.any()


def test_threads_do_not_change_the_result() -> None:
    prior = prior_of(camera())
    depth = prior.depth * np.float32(1.004)
    one, two = (depth_prior_loss(depth, camera(), prior, weight=WEIGHT, threads=n) for n in (1, 2))
    assert one[0] == two[0]
    assert np.array_equal(one[1].depth, two[1].depth)
