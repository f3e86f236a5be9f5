# SPDX-License-Identifier: GPL-3.0-or-later
"""The 3D filter against its definition, camera by camera."""

from __future__ import annotations

import math

import numpy as np

from gaussian_wrapping_addon.core.gaussians.model import mip_filter
from gaussian_wrapping_addon.core.limits import NEAR_Z
from tests.core.render.scenes import look_at


def test_filter_is_its_definition_for_any_thread_count() -> None:
    cameras = [
        look_at((4.0, 0.0, 0.5), focal=60.0),
        look_at((-1.5, 2.0, 1.0), focal=45.0),
        look_at((0.3, 0.1, 0.2), (2.0, 1.0, 0.0), focal=30.0),
    ]
    means = np.random.default_rng(0).uniform(-2, 2, (400, 3))
    depths = np.full(400, math.inf)
    for camera in cameras:
        pixels, depth = camera.project(means)
        inside = depth > NEAR_Z
        for axis, size in ((0, camera.width), (1, camera.height)):
            inside &= (pixels[:, axis] >= -0.15 * size) & (pixels[:, axis] <= 1.15 * size)
        depths[inside] = np.minimum(depths[inside], depth[inside])
    seen = np.isfinite(depths)
    assert 0 < seen.sum() < 400
    depths[~seen] = depths[seen].max()
    wanted = depths / (1.03 * 60.0) * math.sqrt(0.05)
    for threads in (1, 4):
        assert np.abs(mip_filter(means, cameras, threads=threads) - wanted).max() < 1e-12


def test_filter_scales_with_the_image_and_the_scene() -> None:
    camera = look_at((4.0, 0.0, 0.5))
    means = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3))
    full = mip_filter(means, [camera])
    half = mip_filter(means, [camera.resized(camera.width // 2, camera.height // 2)])
    assert np.abs(half / full - 2.0).max() < 1e-9


def test_nothing_seen_or_nothing_there() -> None:
    camera = look_at((4.0, 0.0, 0.5))
    behind = mip_filter(np.array([[100.0, 0.0, 0.0]]), [camera])
    assert behind.shape == (1,)
    assert 0 < behind[0] < 1
    assert mip_filter(np.zeros((0, 3)), [camera]).shape == (0,)
    assert mip_filter(np.zeros((2, 3)), []).tolist() == [0.0, 0.0]
