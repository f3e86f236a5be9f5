# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources confirm true depths and no others; how bright photos are beside each other."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.matching import (
    GAIN,
    LEAST_TOLERANCE_LEVELS,
    NO_BRIGHTNESS,
    RATE,
    MatchingLevel,
)
from tests.core.stereo.textured_plane import cameras, level_of, plane_photos, true_planes


def confirmed(factors: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return bits and means of the first photo where depths are wrong by these factors."""
    given, photos = plane_photos()
    level = level_of(list(photos), list(given))
    for view, camera in enumerate(given):
        level.planes_of(view)[:] = true_planes(camera) / factors[view]
    means = level.confirm(0, level.inverse_depths())
    return level.confirmed[0], means


def test_both_sources_confirm_what_both_show() -> None:
    given, _ = plane_photos()
    bits, means = confirmed((1, 1, 1))
    truth = true_planes(given[0])[..., 0]
    assert means == pytest.approx(truth, rel=1e-3)
    points = (given[0].rays() / truth[..., None] - given[0].cam_from_world[:, 3]) @ given[
        0
    ].rotation
    for source in (1, 2):
        pixels, _ = given[source].project(points.reshape(-1, 3))
        size = np.array([given[source].width, given[source].height])
        inside = ((pixels > 1) & (pixels < size - 1)).all(1).reshape(bits.shape)
        outside = ((pixels < 0) | (pixels > size)).any(1).reshape(bits.shape)
        bit = (bits >> (source - 1)) & 1
        assert bit[inside].all()
        assert not bit[outside].any()
        assert outside.any()


def test_a_wrong_source_does_not_confirm() -> None:
    bits, _ = confirmed((1, 1, 1.1))
    assert set(np.unique(bits)) == {0, 1}
    bits, means = confirmed((1.1, 1, 1))
    assert not bits.any()
    truth = true_planes(plane_photos()[0][0])[..., 0]
    assert means == pytest.approx(truth / 1.1, rel=1e-5)


def test_the_mean_is_over_the_pixel_and_its_sources() -> None:
    bits, means = confirmed((1.0, 1.004, 1.004))
    truth = true_planes(plane_photos()[0][0])[..., 0]
    both = bits == 3
    assert both.mean() > 0.3
    # A plane through the other camera's centre at 1.004 of the distance is nearly 1.004 here.
    assert np.median(means[both] / truth[both]) == pytest.approx((1 + 2 / 1.004) / 3, abs=1e-3)


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
