# SPDX-License-Identifier: GPL-3.0-or-later
"""Geographic coordinates against independent truths, and cameras placed by GPS."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.photos.exif import GpsPosition
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.units.georeference import (
    ECCENTRICITY_2,
    ENOUGH,
    SEMI_MAJOR_M,
    GeoPoint,
    Georeference,
    ecef_from_geographic,
    enu_axes,
    enu_from_geographic,
    geographic_from_ecef,
    geographic_from_enu,
    geographic_from_utm,
    georeference,
    robust_similarity,
    utm_epsg,
    utm_from_geographic,
    utm_of,
    utm_zone,
)
from tests.poses import look_at_pose


def test_corners_of_the_ellipsoid() -> None:
    polar = SEMI_MAJOR_M * np.sqrt(1 - ECCENTRICITY_2)
    found = ecef_from_geographic(np.array([[0, 0, 0], [0, 90, 10], [90, 0, 5], [-90, 12, 0.0]]))
    wanted = [[SEMI_MAJOR_M, 0, 0], [0, SEMI_MAJOR_M + 10, 0], [0, 0, polar + 5], [0, 0, -polar]]
    np.testing.assert_allclose(found, wanted, atol=2e-9)
    assert polar == pytest.approx(6356752.314245, abs=1e-6)


def test_there_and_back_to_a_nanometre() -> None:
    low, high = [-89.9, -180.0, -500.0], [89.9, 180.0, 9e3]
    places = np.random.default_rng(0).uniform(low, high, (500, 3))
    here = np.concatenate([places, [[90.0, 0, 3], [-90, 0, -7], [0, 179.999, 0]]])
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


@pytest.mark.parametrize("latitude", [0.0, -33.0, 83.9])
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
    assert utm_epsg(56, False) == 32756
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


PLACE = GeoPoint(46.84, 179.9999, 210.0)
"""Beside the date line: half of the positions lie across it."""


def flight(count: int = 24) -> np.ndarray:
    """Return (n, 3) metres about PLACE: a grid at changing heights."""
    i = np.arange(count)
    return np.stack([12.0 * (i % 6) - 30, 15.0 * (i // 6) - 22, 40.0 + 3.0 * ((i * 7) % 5)], 1)


TURN = Rotation.random(random_state=3).as_matrix()
WORLD_FROM_ENU = Similarity(0.031, TURN, np.array([4.0, -2.0, 7.0]))


def cameras_at(enu: np.ndarray) -> list[Camera]:
    return [
        Camera(f"p{i:02d}", 100, 80, 90, 90, 50, 40, look_at_pose(place)).moved(WORLD_FROM_ENU)
        for i, place in enumerate(enu)
    ]


def positions_of(enu: np.ndarray) -> dict[str, GpsPosition]:
    places = geographic_from_enu(enu, PLACE)
    return {f"p{i:02d}": GpsPosition(*map(float, place)) for i, place in enumerate(places)}


def placed(enu: np.ndarray, gps: np.ndarray, *given: object) -> Georeference:
    """Return the frame of cameras at some places whose photos state others."""
    return georeference(cameras_at(enu), positions_of(gps), *given)  # type: ignore[arg-type]


def test_exact_positions_give_the_exact_frame() -> None:
    enu = flight()
    found = placed(enu, enu)
    assert found.enu_from_world.scale == pytest.approx(1 / 0.031, rel=1e-9)
    # Up at the found origin, which is the median place.
    wanted = enu_from_geographic(geographic_from_enu(enu, PLACE), found.origin)
    centers = np.array([c.center for c in cameras_at(enu)])
    np.testing.assert_allclose(found.enu_from_world.points(centers), wanted, atol=1e-6)
    assert np.abs(found.origin.longitude_deg) > 179.999
    assert found.details["gps"]["used"] == 24
    assert found.details["gps"]["median_m"] < 1e-6


def test_errors_of_metres_and_a_quarter_of_outliers() -> None:
    rng = np.random.default_rng(5)
    enu = flight(48) * [1.0, 0.7, 1.0]
    noisy = enu + rng.normal(0.0, 1.0, enu.shape)
    wrong = rng.permutation(48)[:12]
    noisy[wrong] += rng.normal(0.0, 1.0, (12, 3)) * 30 + 60
    found = placed(enu, noisy)
    assert set(found.details["gps"]["left_out"]) == {f"p{i:02d}" for i in wrong}
    # The errors that are stated bound those that are made, at four standard deviations.
    scale_error = abs(found.enu_from_world.scale * 0.031 - 1.0)
    assert scale_error < 4 * found.scale_error < 0.08
    up = found.enu_from_world.rotation @ WORLD_FROM_ENU.rotation @ [0.0, 0.0, 1.0]
    true_up = enu_axes(found.origin) @ enu_axes(PLACE).T @ [0.0, 0.0, 1.0]
    tilt = np.degrees(np.arccos(np.clip(up @ true_up, -1, 1)))
    assert tilt < 4 * found.details["gps"]["tilt_error_deg"] < 8.0
    assert 0.5 < found.details["gps"]["rms_m"] < 3.0


def test_another_scale_keeps_the_middle_and_the_axes() -> None:
    enu = flight()
    found = placed(enu, enu)
    other = found.with_scale(2.0 * found.enu_from_world.scale)
    middle = found.centers.mean(0)[None]
    np.testing.assert_allclose(
        other.enu_from_world.points(middle), found.enu_from_world.points(middle), atol=1e-9
    )
    assert (other.enu_from_world.rotation == found.enu_from_world.rotation).all()
    distances = np.linalg.norm(other.enu_from_world.points(found.centers) - found.enu, axis=1)
    assert other.details["gps"]["max_m"] == pytest.approx(distances.max(), rel=1e-3)


def line(count: int) -> np.ndarray:
    return np.stack([10.0 * np.arange(count), 20.0 * np.arange(count), np.full(count, 30.0)], 1)


def noise(count: int, size: float) -> np.ndarray:
    return np.random.default_rng(7).normal(0.0, size, (count, 3))


@pytest.mark.parametrize(
    ("enu", "gps", "words"),
    [
        (flight(4), flight(4), "4 of 4 photos have a GPS position; 5 are needed"),
        (line(20), line(20), "on one line"),
        (line(20) + noise(20, 0.5), line(20) + noise(20, 0.5)[::-1], "almost on one line"),
        (flight() * 0.02, flight() * 0.02 + noise(24, 1.0), "GPS positions"),
        (flight(), np.tile([5.0, 5.0, 0.0], (24, 1)), "in one place"),
        (flight(), noise(24, 500.0), "agree"),
    ],
)
def test_what_does_not_determine_a_frame(enu: np.ndarray, gps: np.ndarray, words: str) -> None:
    with pytest.raises(DatasetError, match=words):
        placed(enu, gps)


def test_what_is_asked_for_may_be_worse() -> None:
    enu = flight() * 0.25
    noisy = enu + noise(24, 1.2)
    with pytest.raises(DatasetError, match="too little for an error of the GPS positions"):
        placed(enu, noisy)
    found = placed(enu, noisy, ENOUGH)
    assert "too little for an error of the GPS positions" in found.doubt
    assert placed(enu, enu).doubt == ""
    worse = enu + noise(24, 5.0)
    with pytest.raises(DatasetError, match="too little for an error"):
        placed(enu, worse, ENOUGH)


def test_photos_without_altitude() -> None:
    enu = flight()
    flat = {
        name: GpsPosition(p.latitude_deg, p.longitude_deg, None)
        for name, p in positions_of(enu).items()
    }
    with pytest.raises(DatasetError, match="0 of 24 photos have a GPS altitude"):
        georeference(cameras_at(enu), flat)


def test_places_half_the_earth_away() -> None:
    enu = flight()
    gps = positions_of(enu)
    gps["p03"] = GpsPosition(-10.0, 20.0, 3.0)
    found = georeference(cameras_at(enu), gps)
    assert found.details["gps"]["left_out"] == ["p03"]
    spread = {f"p{i:02d}": GpsPosition(-80.0 + 6 * i, 14.0 * i, 0.0) for i in range(24)}
    with pytest.raises(DatasetError, match="more than 50 km"):
        georeference(cameras_at(enu), spread)


def test_the_stated_error_is_that_of_repeated_fits() -> None:
    """Scale error and tilt, over many draws of noise, against what each fit says."""
    rng = np.random.default_rng(11)
    source = rng.normal(size=(30, 3)) * [3.0, 1.5, 0.4]
    scales, tilts, stated, stated_tilt = [], [], [], []
    for _ in range(60):
        target = 10 * source + rng.normal(0.0, 0.5, source.shape)
        fit = robust_similarity(source, target, largest_error=25.0, noise=0.01)
        scales.append(fit.target_from_source.scale / 10 - 1)
        stated.append(fit.scale_error)
        # About the largest extent, x: what y and z turn by.
        turned = fit.target_from_source.rotation @ [0.0, 1.0, 0.0]
        tilts.append(np.degrees(np.arctan2(turned[2], turned[1])))
        stated_tilt.append(fit.tilt_error_deg)
    assert np.std(scales) == pytest.approx(np.mean(stated), rel=0.35)
    assert np.std(tilts) == pytest.approx(np.mean(stated_tilt), rel=0.35)
