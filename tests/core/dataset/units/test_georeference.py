# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras are placed by GPS with errors of metres, or refused with the reason."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.photos.exif import GpsPosition
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.units.georeference import (
    ENOUGH,
    GeoPoint,
    enu_axes,
    enu_from_geographic,
    geographic_from_enu,
    georeference,
    robust_similarity,
)
from tests.poses import look_at_pose

PLACE = GeoPoint(46.84, 179.9999, 210.0)
"""Beside the date line: half of the positions lie across it."""


def flight(count: int = 24) -> np.ndarray:
    """Return (n, 3) metres about PLACE: a grid at changing heights."""
    i = np.arange(count)
    return np.stack([12.0 * (i % 6) - 30, 15.0 * (i // 6) - 22, 40.0 + 3.0 * ((i * 7) % 5)], 1)


def cameras_at(enu: np.ndarray, world_from_enu: Similarity) -> list[Camera]:
    out = []
    for i, place in enumerate(enu):
        camera = Camera(f"p{i:02d}", 100, 80, 90, 90, 50, 40, look_at_pose(place, [0, 0, 0]))
        out.append(camera.moved(world_from_enu))
    return out


def positions_of(enu: np.ndarray) -> dict[str, GpsPosition]:
    places = geographic_from_enu(enu, PLACE)
    return {f"p{i:02d}": GpsPosition(*map(float, place)) for i, place in enumerate(places)}


def rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


WORLD_FROM_ENU = Similarity(0.031, rotation(3), np.array([4.0, -2.0, 7.0]))


def test_exact_positions_give_the_exact_frame() -> None:
    enu = flight()
    found = georeference(cameras_at(enu, WORLD_FROM_ENU), positions_of(enu))
    assert found.enu_from_world.scale == pytest.approx(1 / 0.031, rel=1e-9)
    # Up at the found origin, which is the median place.
    places = geographic_from_enu(enu, PLACE)
    wanted = enu_from_geographic(places, found.origin)
    centers = np.array([c.center for c in cameras_at(enu, WORLD_FROM_ENU)])
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
    found = georeference(cameras_at(enu, WORLD_FROM_ENU), positions_of(noisy))
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
    found = georeference(cameras_at(enu, WORLD_FROM_ENU), positions_of(enu))
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
        georeference(cameras_at(enu, WORLD_FROM_ENU), positions_of(gps))


def test_what_is_asked_for_may_be_worse() -> None:
    enu = flight() * 0.25
    noisy = enu + noise(24, 1.2)
    with pytest.raises(DatasetError, match="too little for an error of the GPS positions"):
        georeference(cameras_at(enu, WORLD_FROM_ENU), positions_of(noisy))
    found = georeference(cameras_at(enu, WORLD_FROM_ENU), positions_of(noisy), ENOUGH)
    assert "too little for an error of the GPS positions" in found.doubt
    assert georeference(cameras_at(enu, WORLD_FROM_ENU), positions_of(enu)).doubt == ""
    worse = enu + noise(24, 5.0)
    with pytest.raises(DatasetError, match="too little for an error"):
        georeference(cameras_at(enu, WORLD_FROM_ENU), positions_of(worse), ENOUGH)


def test_photos_without_altitude() -> None:
    enu = flight()
    flat = {
        name: GpsPosition(p.latitude_deg, p.longitude_deg, None)
        for name, p in positions_of(enu).items()
    }
    with pytest.raises(DatasetError, match="0 of 24 photos have a GPS altitude"):
        georeference(cameras_at(enu, WORLD_FROM_ENU), flat)


def test_places_half_the_earth_away() -> None:
    enu = flight()
    gps = positions_of(enu)
    gps["p03"] = GpsPosition(-10.0, 20.0, 3.0)
    found = georeference(cameras_at(enu, WORLD_FROM_ENU), gps)
    assert found.details["gps"]["left_out"] == ["p03"]
    spread = {f"p{i:02d}": GpsPosition(-80.0 + 6 * i, 14.0 * i, 0.0) for i in range(24)}
    with pytest.raises(DatasetError, match="more than 50 km"):
        georeference(cameras_at(enu, WORLD_FROM_ENU), spread)


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
