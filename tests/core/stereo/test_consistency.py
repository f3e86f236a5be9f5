# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources confirm true depths and no others."""

from __future__ import annotations

import numpy as np
import pytest

from tests.core.stereo.textured_plane import level_of, plane_photos, true_planes


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
