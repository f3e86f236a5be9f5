# SPDX-License-Identifier: GPL-3.0-or-later
"""WGS 84: geographic, earth-centred, local east-north-up and UTM coordinates.

Formulas and their orders: docs/method.md, section 13.1. Heights are above the ellipsoid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)
"""Square of the first eccentricity."""
UTM_SCALE = 0.9996
UTM_FALSE_EASTING_M = 500_000.0
UTM_FALSE_NORTHING_M = 10_000_000.0
"""Of the southern hemisphere."""
UTM_MAX_LATITUDE_DEG = 84.0
"""North of it, and south of 80 degrees, UTM is not defined."""
UTM_MIN_LATITUDE_DEG = -80.0
_ROUNDS = 12
"""Of the fixed points below; each gains more than two digits."""


@dataclass(frozen=True)
class GeoPoint:
    """A place on WGS 84."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "latitude_deg": self.latitude_deg,
            "longitude_deg": self.longitude_deg,
            "altitude_m": self.altitude_m,
        }


def ecef_from_geographic(places: np.ndarray) -> np.ndarray:
    """Return earth-centred, earth-fixed coordinates.

    Parameters
    ----------
    places : (n, 3) float64
        Latitude and longitude in degrees, height in metres.

    Returns
    -------
    (n, 3) float64, metres
    """
    places = np.asarray(places, np.float64).reshape(-1, 3)
    latitude, longitude = np.radians(places[:, 0]), np.radians(places[:, 1])
    height = places[:, 2]
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    return np.stack(
        [
            across * np.cos(longitude),
            across * np.sin(longitude),
            (normal * (1.0 - ECCENTRICITY_2) + height) * np.sin(latitude),
        ],
        1,
    )


def geographic_from_ecef(points: np.ndarray) -> np.ndarray:
    """Return latitude and longitude in degrees and height in metres of (n, 3) ECEF points.

    Accurate to rounding for heights between -10 km and satellites; undefined near the centre.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    across = np.hypot(points[:, 0], points[:, 1])
    latitude = np.arctan2(points[:, 2], across * (1.0 - ECCENTRICITY_2))
    for _ in range(_ROUNDS):
        sine = np.sin(latitude)
        normal = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_2 * sine**2)
        latitude = np.arctan2(points[:, 2] + ECCENTRICITY_2 * normal * sine, across)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    surface = SEMI_MAJOR_M * np.sqrt(1.0 - ECCENTRICITY_2 * sine**2)
    # Exact at the poles as well, where the usual division by the cosine is not.
    height = across * cosine + points[:, 2] * sine - surface
    longitude = np.arctan2(points[:, 1], points[:, 0])
    return np.stack([np.degrees(latitude), np.degrees(longitude), height], 1)


def enu_axes(origin: GeoPoint) -> np.ndarray:
    """Return the (3, 3) rotation whose rows are east, north and up at a place, in ECEF axes."""
    latitude, longitude = math.radians(origin.latitude_deg), math.radians(origin.longitude_deg)
    sl, cl, so, co = (
        math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude),
    )  # fmt: skip
    return np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])


def enu_from_geographic(places: np.ndarray, origin: GeoPoint) -> np.ndarray:
    """Return (n, 3) metres east, north and up of ``origin`` of (n, 3) geographic places."""
    return (ecef_from_geographic(places) - _ecef(origin)) @ enu_axes(origin).T


def geographic_from_enu(points: np.ndarray, origin: GeoPoint) -> np.ndarray:
    """Return (n, 3) latitude, longitude (degrees) and height of (n, 3) points about ``origin``."""
    return geographic_from_ecef(np.asarray(points, np.float64) @ enu_axes(origin) + _ecef(origin))


def utm_zone(latitude_deg: float, longitude_deg: float) -> int | None:
    """Return the number of the UTM zone of a place, None near the poles.

    Includes the exceptions of Norway and Svalbard.
    """
    if not UTM_MIN_LATITUDE_DEG <= latitude_deg <= UTM_MAX_LATITUDE_DEG:
        return None
    longitude = (longitude_deg + 180.0) % 360.0 - 180.0
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude < 12.0:
        return 32
    if latitude_deg >= 72.0 and 0.0 <= longitude < 42.0:
        return 31 if longitude < 9.0 else 33 if longitude < 21.0 else 35 if longitude < 33.0 else 37
    return min(int((longitude + 180.0) // 6.0) + 1, 60)


def utm_epsg(zone: int, north: bool) -> int:
    """Return the EPSG number of a UTM zone on WGS 84."""
    return (32600 if north else 32700) + zone


def utm_from_geographic(places: np.ndarray, zone: int, north: bool) -> np.ndarray:
    """Return (n, 3) easting, northing and height in metres of (n, 3) geographic places."""
    places = np.asarray(places, np.float64).reshape(-1, 3)
    latitude = np.radians(places[:, 0])
    longitude = np.radians((places[:, 1] - _meridian_deg(zone) + 180.0) % 360.0 - 180.0)
    e = math.sqrt(ECCENTRICITY_2)
    sine = np.sin(latitude)
    t = np.sinh(np.arctanh(sine) - e * np.arctanh(e * sine))
    xi = np.arctan2(t, np.cos(longitude))
    eta = np.arcsinh(np.sin(longitude) / np.hypot(t, np.cos(longitude)))
    radius, alpha, _ = _series()
    northing, easting = xi.copy(), eta.copy()
    for j, a in enumerate(alpha, 1):
        northing += a * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
        easting += a * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
    return np.stack(
        [
            UTM_FALSE_EASTING_M + UTM_SCALE * radius * easting,
            UTM_SCALE * radius * northing + (0.0 if north else UTM_FALSE_NORTHING_M),
            places[:, 2],
        ],
        1,
    )


def geographic_from_utm(points: np.ndarray, zone: int, north: bool) -> np.ndarray:
    """Return (n, 3) latitude, longitude (degrees) and height of (n, 3) UTM coordinates."""
    points = np.asarray(points, np.float64).reshape(-1, 3)
    radius, _, beta = _series()
    xi = (points[:, 1] - (0.0 if north else UTM_FALSE_NORTHING_M)) / (UTM_SCALE * radius)
    eta = (points[:, 0] - UTM_FALSE_EASTING_M) / (UTM_SCALE * radius)
    xi_0, eta_0 = xi.copy(), eta.copy()
    for j, b in enumerate(beta, 1):
        xi_0 -= b * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
        eta_0 -= b * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
    longitude = np.arctan2(np.sinh(eta_0), np.cos(xi_0))
    conformal = np.sin(xi_0) / np.hypot(np.sinh(eta_0), np.cos(xi_0))  # tangent of the latitude
    e = math.sqrt(ECCENTRICITY_2)
    latitude = np.arctan(conformal)
    for _ in range(_ROUNDS):
        sine = np.sin(latitude)
        latitude = np.arctan(np.sinh(np.arcsinh(conformal) + e * np.arctanh(e * sine)))
    degrees = (np.degrees(longitude) + _meridian_deg(zone) + 180.0) % 360.0 - 180.0
    return np.stack([np.degrees(latitude), degrees, points[:, 2]], 1)


def utm_of(origin: GeoPoint) -> dict[str, Any] | None:
    """Return zone, EPSG number and coordinates of a place in UTM as JSON values, None at poles."""
    zone = utm_zone(origin.latitude_deg, origin.longitude_deg)
    if zone is None:
        return None
    north = origin.latitude_deg >= 0.0
    place = [[origin.latitude_deg, origin.longitude_deg, origin.altitude_m]]
    easting, northing, _ = utm_from_geographic(np.array(place), zone, north)[0]
    return {
        "zone": f"{zone}{'N' if north else 'S'}",
        "epsg": utm_epsg(zone, north),
        "easting_m": float(easting),
        "northing_m": float(northing),
    }


def _ecef(origin: GeoPoint) -> np.ndarray:
    place = [[origin.latitude_deg, origin.longitude_deg, origin.altitude_m]]
    return ecef_from_geographic(np.array(place))[0]


def _meridian_deg(zone: int) -> float:
    return 6.0 * zone - 183.0


def _series() -> tuple[float, tuple[float, ...], tuple[float, ...]]:
    """Return the rectifying radius and Krueger's coefficients, forward and back, to order 4.

    The third flattening is 1/600: the first term left out is below 1e-9 m within a zone.
    """
    n = FLATTENING / (2.0 - FLATTENING)
    radius = SEMI_MAJOR_M / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0)
    alpha = (
        n / 2.0 - 2.0 * n**2 / 3.0 + 5.0 * n**3 / 16.0 + 41.0 * n**4 / 180.0,
        13.0 * n**2 / 48.0 - 3.0 * n**3 / 5.0 + 557.0 * n**4 / 1440.0,
        61.0 * n**3 / 240.0 - 103.0 * n**4 / 140.0,
        49561.0 * n**4 / 161280.0,
    )
    beta = (
        n / 2.0 - 2.0 * n**2 / 3.0 + 37.0 * n**3 / 96.0 - n**4 / 360.0,
        n**2 / 48.0 + n**3 / 15.0 - 437.0 * n**4 / 1440.0,
        17.0 * n**3 / 480.0 - 37.0 * n**4 / 840.0,
        4397.0 * n**4 / 161280.0,
    )
    return radius, alpha, beta
