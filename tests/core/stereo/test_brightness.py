# SPDX-License-Identifier: GPL-3.0-or-later
"""Gains between photos of a plane, and what they say about a ramp of shading."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.stereo.brightness import (
    GAIN,
    LEAST_TOLERANCE_LEVELS,
    NO_BRIGHTNESS,
    RATE,
)
from gaussian_wrapping_addon.core.stereo.matching_level import MatchingLevel
from tests.core.stereo.textured_plane import cameras, level_of, plane_photos, true_planes

DARKER = 0.7


def compared(photos: list[np.ndarray], given: list[Camera] | None = None) -> MatchingLevel:
    """Return the level of the true planes of photos, brightness compared."""
    level = level_of(photos, list(plane_photos()[0]) if given is None else given)
    for view, camera in enumerate(level.cameras):
        level.planes_of(view)[:] = true_planes(camera)
    depths = level.inverse_depths()
    for view in range(len(level)):
        level.confirm(view, depths)
    level.compare_brightness()
    return level


def test_gains_of_exposure_are_found() -> None:
    first, second, third = plane_photos()[1]
    level = compared([first, np.round(DARKER * second).astype(np.uint8), third])
    assert level.brightness[0][:, GAIN] == pytest.approx([1 / DARKER, 1.0], rel=0.03)
    assert level.brightness[1][:, GAIN] == pytest.approx([DARKER, DARKER], rel=0.03)
    tolerances = 1.0 / np.concatenate(level.brightness)[:, RATE]
    assert tolerances.min() >= LEAST_TOLERANCE_LEVELS
    assert tolerances.max() < 12.0


def test_differences_count_less_where_the_light_has_changed() -> None:
    first, second, third = plane_photos()[1]
    across = np.linspace(-40.0, 40.0, second.shape[1])
    lit = np.clip(second + across, 0, 255).astype(np.uint8)
    tolerances = 1.0 / compared([first, lit, third]).brightness[0][:, RATE]
    assert tolerances[0] > 30.0
    assert tolerances[1] < 12.0


def test_brightness_is_not_compared_where_hardly_a_pixel_agrees() -> None:
    level = level_of(list(plane_photos()[1]), list(plane_photos()[0]))
    level.planes_of(1)[:] = true_planes(level.cameras[1])
    level.compare_brightness()  # nothing was confirmed
    for found in level.brightness:
        assert (found == NO_BRIGHTNESS).all()


def shaded_photo(camera: Camera) -> np.ndarray:
    """Return a photo of the plane without texture: a ramp of shading along x, and its noise."""
    rays = camera.rays() / true_planes(camera)[..., :1]
    points = (rays - camera.cam_from_world[:, 3]) @ camera.rotation
    noise = np.random.default_rng(len(camera.name)).normal(0.0, 0.5, points.shape[:2])
    return np.round(128 + 40 * points[..., 0] + noise).clip(0, 255).astype(np.uint8)


def test_a_ramp_of_shading_tells_the_depth() -> None:
    """A window sees but a ramp, which correlates with itself at any depth."""
    given = cameras(5)
    photos = [shaded_photo(camera) for camera in given]
    errors = []
    for compare in (False, True):
        level = compared(photos, given)
        if not compare:
            level.brightness = [np.tile(NO_BRIGHTNESS, (len(s), 1)) for s in level.sources]
        level.planes_of(2)[..., 0] *= np.random.default_rng(1).uniform(0.9, 1.1, (48, 64))
        for turn in range(3):
            level.sweep(2, turn, 0)
        truth = true_planes(given[2])[..., 0]
        inside = (slice(12, 36), slice(16, 48))
        errors.append(float(np.median(np.abs(level.planes_of(2)[..., 0] / truth - 1)[inside])))
    assert errors[1] < 0.01
    assert errors[1] < 0.4 * errors[0]
