# SPDX-License-Identifier: GPL-3.0-or-later
"""Geographic, earth-centred, local and UTM coordinates agree with independent truths."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from gaussian_wrapping_addon.core.units.georeference import (
    ECCENTRICITY_2,
    SEMI_MAJOR_M,
    GeoPoint,
    ecef_from_geographic,
    enu_axes,
    enu_from_geographic,
    geographic_from_ecef,
    geographic_from_enu,
    geographic_from_utm,
    utm_epsg,
    utm_from_geographic,
    utm_of,
    utm_zone,
)


def places(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = [-89.9, -180.0, -500.0], [89.9, 180.0, 9e3]
    return rng.uniform(low, high, (count, 3))


def test_corners_of_the_ellipsoid() -> None:
    polar = SEMI_MAJOR_M * np.sqrt(1 - ECCENTRICITY_2)
    found = ecef_from_geographic(np.array([[0, 0, 0], [0, 90, 10], [90, 0, 5], [-90, 12, 0.0]]))
    wanted = [[SEMI_MAJOR_M, 0, 0], [0, SEMI_MAJOR_M + 10, 0], [0, 0, polar + 5], [0, 0, -polar]]
    np.testing.assert_allclose(found, wanted, atol=2e-9)
    assert polar == pytest.approx(6356752.314245, abs=1e-6)


def test_there_and_back_to_a_nanometre() -> None:
    here = np.concatenate([places(500, 0), [[90.0, 0, 3], [-90, 0, -7], [0, 179.999, 0]]])
    xyz = ecef_from_geographic(here)
    again = geographic_from_ecef(xyz)
    np.testing.assert_allclose(again[:, 2], here[:, 2], atol=4e-9)
    assert np.abs(ecef_from_geographic(again) - xyz).max() < 4e-9


def test_up_is_the_normal_and_north_points_to_the_pole() -> None:
    origin = GeoPoint(-37.0, 145.0, 120.0)
    axes = enu_axes(origin)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    step = np.array([[-37.0, 145.0, 121.0], [-36.99999, 145.0, 120.0], [-37.0, 145.00001, 120.0]])
    up, north, east = enu_from_geographic(step, origin)
    np.testing.assert_allclose(up, [0, 0, 1], atol=2e-9)
    assert north[1] > 1.1
    assert abs(north[0]) < 1e-6
    assert 0.8 < east[0] < 0.9
    assert abs(east[1]) < 1e-6


def test_enu_is_rigid_and_comes_back() -> None:
    origin = GeoPoint(47.5, 8.5, 400.0)
    points = np.random.default_rng(1).normal(size=(50, 3)) * 300
    there = geographic_from_enu(points, origin)
    np.testing.assert_allclose(enu_from_geographic(there, origin), points, atol=5e-9)
    distances = np.linalg.norm(np.diff(ecef_from_geographic(there), axis=0), axis=1)
    wanted = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(distances, wanted, atol=5e-9)


@pytest.mark.parametrize("latitude", [0.0, 12.5, -33.0, 59.0, 83.9])
def test_northing_on_the_central_meridian_is_the_meridian_arc(latitude: float) -> None:
    def radius(phi: mpmath.mpf) -> mpmath.mpf:
        sine_2 = mpmath.sin(phi) ** 2
        return SEMI_MAJOR_M * (1 - ECCENTRICITY_2) / (1 - ECCENTRICITY_2 * sine_2) ** 1.5

    arc = float(mpmath.quad(radius, [0, mpmath.radians(latitude)]))
    east, north, height = utm_from_geographic(np.array([[latitude, 9.0, 7.0]]), 32, True)[0]
    assert east == pytest.approx(500_000.0, abs=1e-9)
    assert north == pytest.approx(0.9996 * arc, abs=1e-6)
    assert height == 7.0


def test_a_published_place() -> None:
    # The CN Tower, as maps give it: 43 38 33.24 N, 79 23 13.7 W is 17T 630084 4833438.
    place = GeoPoint(43 + 38 / 60 + 33.24 / 3600, -(79 + 23 / 60 + 13.7 / 3600), 0.0)
    found = utm_of(place)
    assert found is not None
    assert (found["zone"], found["epsg"]) == ("17N", 32617)
    assert found["easting_m"] == pytest.approx(630084, abs=1.0)
    assert found["northing_m"] == pytest.approx(4833438, abs=1.0)


def test_utm_is_conformal_and_comes_back() -> None:
    rng = np.random.default_rng(2)
    here = np.stack([rng.uniform(-79, 83, 300), 3 + rng.uniform(-3.5, 3.5, 300), np.zeros(300)], 1)
    for north in (True, False):
        there = utm_from_geographic(here, 31, north)
        again = geographic_from_utm(there, 31, north)
        assert np.abs(ecef_from_geographic(again) - ecef_from_geographic(here)).max() < 1e-6
    # Conformal: steps of a millionth of a degree along parallel and meridian are at right angles
    # and stretched alike.
    north_step, east_step = np.array([1e-6, 0, 0]), np.array([0, 1e-6, 0])
    base = utm_from_geographic(here, 31, True)[:, :2]
    by_north = utm_from_geographic(here + north_step, 31, True)[:, :2] - base
    by_east = utm_from_geographic(here + east_step, 31, True)[:, :2] - base
    xyz = ecef_from_geographic(here)
    true_north = np.linalg.norm(ecef_from_geographic(here + north_step) - xyz, axis=1)
    true_east = np.linalg.norm(ecef_from_geographic(here + east_step) - xyz, axis=1)
    stretch = np.linalg.norm(by_north, axis=1) / true_north
    np.testing.assert_allclose(np.linalg.norm(by_east, axis=1) / true_east, stretch, rtol=2e-5)
    cosine = (by_north * by_east).sum(1) / (
        np.linalg.norm(by_north, axis=1) * np.linalg.norm(by_east, axis=1)
    )
    assert np.abs(cosine).max() < 2e-5


@pytest.mark.parametrize(
    ("latitude", "longitude", "zone"),
    [
        (0.0, -180.0, 1), (0.0, 179.9, 60), (0.0, 180.0, 1), (47.0, 8.0, 32), (60.0, 5.0, 32),
        (64.0, 5.0, 31), (75.0, 10.0, 33), (75.0, 40.0, 37), (75.0, -1.0, 30), (85.0, 0.0, None),
        (-81.0, 0.0, None),
    ],
)  # fmt: skip
def test_zones(latitude: float, longitude: float, zone: int | None) -> None:
    assert utm_zone(latitude, longitude) == zone


def test_epsg() -> None:
    assert utm_epsg(33, True) == 32633
    assert utm_epsg(56, False) == 32756
