# SPDX-License-Identifier: GPL-3.0-or-later
"""Distances of photos by GPS."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.photos.exif import GpsPosition
from gaussian_wrapping_addon.core.poses.matching import gps_distances


def test_metres_on_the_ground() -> None:
    # A minute of latitude is 1853 m on a sphere of this radius; of longitude half of it at 60 deg.
    minute = 1 / 60
    positions = [
        GpsPosition(60.0, 10.0, 5.0),
        GpsPosition(60.0 + minute, 10.0, 900.0),
        None,
        GpsPosition(60.0, 10.0 + minute, None),
    ]
    metres = gps_distances(positions)
    assert metres is not None
    np.testing.assert_array_equal(metres, metres.T)
    assert metres[0, 1] == pytest.approx(1853.25, abs=0.1)
    assert metres[0, 3] == pytest.approx(1853.25 / 2, abs=0.1)
    assert np.isinf(metres[2]).all()


def test_the_date_line_is_no_distance() -> None:
    positions = [GpsPosition(0.0, lon, 0.0) for lon in (179.999, -179.999, 179.998)]
    metres = gps_distances(positions)
    assert metres is not None
    assert metres.max() < 400.0


def test_nothing_is_told_by_too_few_or_equal_positions() -> None:
    here = GpsPosition(48.0, 8.0, 100.0)
    assert gps_distances([here, None, GpsPosition(48.1, 8.0, 0.0)]) is None
    assert gps_distances([here] * 5) is None
    assert gps_distances([None] * 5) is None
