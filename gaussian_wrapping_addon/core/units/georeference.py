# SPDX-License-Identifier: GPL-3.0-or-later
"""Metres and places on the earth from GPS of photos."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import DatasetError
from ..photos.exif import GpsPosition
from ..scene.camera import Camera, Similarity
from ..scene.placement import fit_similarity, umeyama_ransac

# -- WGS 84: geographic, earth-centred, local east-north-up and UTM coordinates -------------------
#
# Formulas and their orders: docs/method.md, section 13.1. Heights are above the ellipsoid.

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


def ecef_from_geographic(places: np.ndarray) -> np.ndarray:
    """Return earth-centred, earth-fixed coordinates.

    ``places``: (n, 3) float64, latitude and longitude in degrees, height in metres.
    Returns (n, 3) float64, metres.
    """
    places = np.asarray(places, np.float64).reshape(-1, 3)
    latitude, longitude = np.radians(places[:, 0]), np.radians(places[:, 1])
    height = places[:, 2]
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    x, y = across * np.cos(longitude), across * np.sin(longitude)
    return np.stack([x, y, (normal * (1.0 - ECCENTRICITY_2) + height) * np.sin(latitude)], 1)


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
    sl, cl, so, co = (f(angle) for angle in (latitude, longitude) for f in (math.sin, math.cos))
    return np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])


def enu_from_geographic(places: np.ndarray, origin: GeoPoint) -> np.ndarray:
    """Return (n, 3) metres east, north and up of ``origin`` of (n, 3) geographic places."""
    return (ecef_from_geographic(places) - ecef_from_geographic(_row(origin))) @ enu_axes(origin).T


def geographic_from_enu(points: np.ndarray, origin: GeoPoint) -> np.ndarray:
    """Return (n, 3) latitude, longitude (degrees) and height of (n, 3) points about ``origin``."""
    points = np.asarray(points, np.float64) @ enu_axes(origin)
    return geographic_from_ecef(points + ecef_from_geographic(_row(origin)))


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
    easting = UTM_FALSE_EASTING_M + UTM_SCALE * radius * easting
    northing = UTM_SCALE * radius * northing + (0.0 if north else UTM_FALSE_NORTHING_M)
    return np.stack([easting, northing, places[:, 2]], 1)


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
    easting, northing, _ = utm_from_geographic(_row(origin), zone, north)[0]
    return {
        "zone": f"{zone}{'N' if north else 'S'}", "epsg": utm_epsg(zone, north),
        "easting_m": float(easting), "northing_m": float(northing),
    }  # fmt: skip


def _row(place: GeoPoint) -> np.ndarray:
    return np.array([[place.latitude_deg, place.longitude_deg, place.altitude_m]])


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


# -- Robust similarity from scene points to metric points, with its uncertainty -------------------
#
# Errors of GPS are not known beforehand: the inlier threshold is halved for as long as enough
# pairs agree (docs/method.md, section 13.2).

MIN_AGREEING_SHARE = 2.0 / 3.0
"""Share of the pairs that a threshold has to keep: with fewer, most of a set may be wrong alike."""
INLIER_SIGMAS = 3.0
"""Pairs within this many standard deviations of the final fit are used."""
ITERATIONS = 2000
"""Triples: with a third of outliers, all fail with a probability of 1e-300."""
_FIT_ROUNDS = 10
_PARAMETERS = 7
"""Of a similarity."""


@dataclass(frozen=True)
class RobustFit:
    """A similarity, the pairs that it rests on, and how well these determine it."""

    target_from_source: Similarity
    used: np.ndarray
    """(n,) bool."""
    residuals: np.ndarray
    """(n,) distances of all pairs, units of the target."""
    sigma: float
    """Standard deviation of a coordinate of the used pairs, units of the target; at least the
    noise that was stated beforehand."""
    scale_error: float
    """Relative standard deviation of the scale."""
    tilt_error_deg: float
    """Standard deviation of the rotation about its least determined axis."""
    reach: float
    """Root mean square distance of the used pairs from their middle, units of the target."""
    lever: float
    """The same from the line through them that they lie closest to."""


def robust_similarity(
    source: np.ndarray, target: np.ndarray, *, largest_error: float, noise: float
) -> RobustFit:
    """Fit a similarity to pairs of which up to a third are wrong.

    Parameters
    ----------
    source, target : (n, 3) float64
    largest_error : float
        Error, units of the target, beyond which a pair is wrong in any case.
    noise : float
        Smallest standard deviation of a target coordinate to reckon with, units of the target:
        residuals of few pairs may be small by chance.

    Raises
    ------
    DatasetError
        Fewer than three pairs, all on one line or in one place, or no agreement of two thirds.
    """
    needed = max(3, math.ceil(MIN_AGREEING_SHARE * len(source)))
    threshold, best = largest_error, None
    while threshold >= noise:
        try:
            found = umeyama_ransac(
                source, target, threshold=threshold, iterations=ITERATIONS, seed=0
            )
        except DatasetError:
            if best is None:
                raise
            break  # a threshold below the errors leaves nothing
        if int(found.inliers.sum()) < needed:
            break
        best = found
        threshold *= 0.5
    if best is None:
        raise DatasetError(
            f"Fewer than two thirds of the {len(source)} positions agree within "
            f"{largest_error:.3g} m."
        )
    return refined_similarity(source, target, best.inliers, noise=noise)


def refined_similarity(
    source: np.ndarray, target: np.ndarray, used: np.ndarray, *, noise: float
) -> RobustFit:
    """Refit to the used pairs until these are all those within :data:`INLIER_SIGMAS`.

    Parameters as of :func:`robust_similarity`; ``used`` (n,) bool is where to begin.
    """
    for round_ in range(_FIT_ROUNDS + 1):
        fit = fit_similarity(source[used], target[used], True)
        residuals = np.linalg.norm(fit.points(source) - target, axis=1)
        # Of one coordinate.
        freedom = max(3 * int(used.sum()) - _PARAMETERS, 1)
        sigma = max(math.sqrt(float((residuals[used] ** 2).sum()) / freedom), noise)
        within = residuals <= INLIER_SIGMAS * math.sqrt(3.0) * sigma
        if (within == used).all() or within.sum() < 3 or round_ == _FIT_ROUNDS:
            break
        used = within
    local = fit.points(source[used])
    local = local - local.mean(0)
    extents = np.linalg.eigvalsh(local.T @ local)  # ascending
    # About an axis, a rotation moves points by their distance from it; the least determined axis
    # is that of the largest extent.
    lever = math.sqrt(max(float(extents[0] + extents[1]), 0.0))
    reach = math.sqrt(float(extents.sum()))
    tilt = math.degrees(sigma / lever) if lever > 0.0 else math.inf
    root = math.sqrt(len(local))
    return RobustFit(fit, used, residuals, sigma, sigma / reach, tilt, reach / root, lever / root)


# -- The record of how a scene got its metres, as it goes with results and exports ----------------

VERSION = 1
GPS, MARKERS, CONTROL_POINTS = "gps", "markers", "control points"
"""Sources of metres."""
GEOGRAPHIC_CRS = "EPSG:4979"
"""WGS 84 with heights, of the origin."""
ORTHONORMAL = 1e-6
"""Tolerance of a rotation that was read from a file."""
MOST_LISTED = 50
"""Names of outliers that a record lists."""
FAR_IN_SIZES = 1000.0
"""Farther than this many scene units from the origin, single precision shows in Blender."""


@dataclass(frozen=True)
class RealUnits:
    """A metric frame of a scene.

    ``metric_from_world`` leads there from the input's cameras. Where ``applied``, results are
    written in the metric frame.
    """

    sources: tuple[str, ...]
    """Of :data:`GPS`, :data:`MARKERS`, :data:`CONTROL_POINTS`; the first one decides the frame."""
    metric_from_world: Similarity
    applied: bool
    z_up: bool
    """Whether the metric frame's z points up; with markers alone its axes are those of the input.
    """
    scale_error: float
    """Relative standard deviation of the scale."""
    origin: GeoPoint | None = None
    """Place of the metric frame's origin, whose x is east, y north and z up."""
    details: dict[str, Any] = field(default_factory=dict)
    """What was measured, with residuals, as JSON values, by source."""

    def to_json(self) -> dict[str, Any]:
        """Return the entry ``georeference`` of ``scene.json`` (docs/file-formats.md)."""
        metric, world = self.metric_from_world, Similarity()
        frame = "axes of the input, in metres"
        if self.origin is not None:
            frame = "local east-north-up about the origin"
        elif self.z_up:
            frame = "local coordinates of the control points"
        return {
            "version": VERSION, "sources": list(self.sources), "unit": "metre", "frame": frame,
            "z_up": self.z_up, "applied": self.applied,
            "origin": None if self.origin is None else dataclasses.asdict(self.origin),
            "crs": None if self.origin is None else GEOGRAPHIC_CRS,
            "utm": None if self.origin is None else utm_of(self.origin),
            "metric_from_world": (world if self.applied else metric).to_json(),
            "world_from_input": (metric if self.applied else world).to_json(),
            "scale_error": self.scale_error, **self.details,
        }  # fmt: skip


def metric_from_world(record: Any) -> Similarity | None:
    """Return ``metric_from_world`` of an entry ``georeference``; None where it holds none.

    Entries that were changed by others may hold anything.
    """
    try:
        found = Similarity.from_json(record["metric_from_world"])
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    if not (found.scale > 0.0 and np.isfinite(found.matrix()).all()):
        return None
    turned = found.rotation @ found.rotation.T
    proper = np.abs(turned - np.eye(3)).max() < ORTHONORMAL and np.linalg.det(found.rotation) > 0.0
    return found if proper else None


def blender_start(record: Any, world_from_scene: Similarity) -> Similarity | None:
    """Return where Blender first places a scene that has metres, or None to leave it as trained.

    Where z is up in the metric frame, the scene is placed in that frame, far coordinates less whole
    metres; else it keeps its own axes and origin, in metres.

    ``record``: the entry ``georeference``, perhaps None.
    """
    metric = metric_from_world(record)
    if metric is None or not record.get("applied"):
        return None
    placed = metric.after(world_from_scene)
    if not record.get("z_up"):
        return Similarity(placed.scale)
    far = float(np.abs(placed.translation).max()) > FAR_IN_SIZES * placed.scale
    offset = np.round(placed.translation) if far else np.zeros(3)
    return Similarity(placed.scale, placed.rotation, placed.translation - offset)


def listed(names: list[str]) -> list[str]:
    """Return the names that a record holds: at most :data:`MOST_LISTED`."""
    return sorted(names)[:MOST_LISTED]


def rounded(value: float) -> float | None:
    """Return a measured number with four significant digits, None where it is not finite."""
    return float(f"{value:.4g}") if math.isfinite(value) else None


# -- Place solved cameras on the earth by the GPS positions of their photos -----------------------

MIN_POSITIONS = 5
"""Photos with a position: with three or four, nothing tells a wrong one."""
LARGEST_ERROR_M = 25.0
"""Positions further off are wrong: receivers are off by metres, beside walls by 20."""
GPS_NOISE_M = 0.3
"""Least error of a position to reckon with; receivers with corrections have centimetres, but
heights of the antenna and times of exposure differ."""
MAX_EXTENT_M = 50_000.0
"""Largest distance of a position from the origin: beyond, the earth's curve shows in a flat frame,
and positions of a single scene do not lie so far apart."""


@dataclass(frozen=True)
class Needs:
    """How well positions have to determine a frame."""

    scale_error: float
    """Largest relative standard deviation of the scale."""
    tilt_deg: float
    """Largest standard deviation of the up direction."""
    reach_sigmas: float
    """Least spread of the cameras over the error of a position. GPS errors of neighbouring photos
    are alike: their number does not make up for a scene that is no larger than the errors."""
    lever_sigmas: float
    """The same for the spread to the sides of a line."""


GOOD = Needs(0.05, 3.0, 8.0, 3.0)
"""To be used without being asked: cameras alone tell up to a few degrees, and a scale that is less
certain is worth less than a measured length."""
ENOUGH = Needs(0.1, 10.0, 3.0, 1.5)
"""To be used where asked for, with a warning where it is not good."""


@dataclass(frozen=True)
class Georeference:
    """A scene placed on the earth."""

    origin: GeoPoint
    enu_from_world: Similarity
    scale_error: float
    """Relative standard deviation of the scale."""
    centers: np.ndarray
    """(n, 3) camera centres, frame of the cameras."""
    enu: np.ndarray
    """(n, 3) their GPS positions."""
    used: np.ndarray
    """(n,) bool, positions that agree."""
    details: dict[str, Any]
    doubt: str = ""
    """Why it is not :data:`GOOD`; empty where it is."""

    def with_scale(self, scale: float) -> Georeference:
        """Return the same rotation with another scale; the middle of the cameras stays."""
        middle = self.centers[self.used].mean(0)
        rotation = self.enu_from_world.rotation
        place = self.enu_from_world.points(middle[None])[0]
        moved = Similarity(scale, rotation, place - scale * (rotation @ middle))
        gps = {**self.details["gps"], **_residuals(moved, self.centers, self.enu, self.used)}
        return dataclasses.replace(self, enu_from_world=moved, details={"gps": gps})


def _residuals(
    fit: Similarity, centers: np.ndarray, enu: np.ndarray, used: np.ndarray
) -> dict[str, Any]:
    distances = np.linalg.norm(fit.points(centers) - enu, axis=1)
    return {
        "median_m": rounded(float(np.median(distances))),
        "rms_m": rounded(float(np.sqrt((distances[used] ** 2).mean()))),
        "max_m": rounded(float(distances.max())),
    }


def georeference(
    cameras: Sequence[Camera], positions: Mapping[str, GpsPosition], needs: Needs = GOOD
) -> Georeference:
    """Fit the cameras' centres to the GPS positions of their photos.

    Parameters
    ----------
    cameras : sequence of Camera
        In any common frame ("world").
    positions : mapping
        By the cameras' names; photos without one are left out.
    needs : Needs
        What the positions have to determine.

    Returns
    -------
    Georeference
        The origin is the median of the positions.

    Raises
    ------
    DatasetError
        Too few positions, or they do not determine scale and up direction; says why.
    """
    known = [c for c in cameras if c.name in positions]
    check_positions([positions[c.name] for c in known], len(cameras))
    used = [c for c in known if positions[c.name].altitude_m is not None]
    gps = [positions[c.name] for c in used]
    places = np.array([(p.latitude_deg, p.longitude_deg, p.altitude_m or 0.0) for p in gps])
    origin = _origin(places)
    enu = enu_from_geographic(places, origin)
    far = np.linalg.norm(enu, axis=1) > MAX_EXTENT_M
    kept = [c for c, out in zip(used, far, strict=True) if not out]
    if len(kept) < MIN_POSITIONS:
        text = "The GPS positions are spread over more than 50 km."
        raise DatasetError(text, "Remove photos of other places.")
    centers, target = np.array([c.center for c in kept]), enu[~far]
    largest = max([LARGEST_ERROR_M, *(3.0 * p.error_m for p in gps if p.error_m is not None)])
    fit = robust_similarity(
        centers, target, largest_error=min(largest, 4 * LARGEST_ERROR_M), noise=GPS_NOISE_M
    )
    if missing := _doubt(fit, needs):
        hint = "Take photos from places further apart, not all on one line; or measure a distance."
        raise DatasetError(missing, hint)
    wrong = [c.name for c, good in zip(kept, fit.used, strict=True) if not good]
    wrong += [c.name for c, out in zip(used, far, strict=True) if out]
    dops = [p.dop for p in gps if p.dop is not None]
    errors = [p.error_m for p in gps if p.error_m is not None]
    levels = {p.altitude_reference for p in gps}
    details = {
        "gps": {
            "photos": len(cameras), "photos_with_position": len(used),
            "used": int(fit.used.sum()), "left_out": listed(wrong),
            **_residuals(fit.target_from_source, centers, target, fit.used),
            "tilt_error_deg": rounded(fit.tilt_error_deg),
            "altitude_reference": levels.pop() if len(levels) == 1 else "mixed",
            "dop_median": rounded(float(np.median(dops))) if dops else None,
            "stated_error_median_m": rounded(float(np.median(errors))) if errors else None,
        }
    }  # fmt: skip
    return Georeference(
        origin, fit.target_from_source, fit.scale_error, centers, target, fit.used, details,
        _doubt(fit, GOOD),
    )  # fmt: skip


def check_positions(known: Sequence[GpsPosition], photos: int) -> None:
    """Raise :class:`DatasetError` where too few of the photos have a position with altitude."""
    used = sum(position.altitude_m is not None for position in known)
    if used < MIN_POSITIONS:
        what = "GPS altitude" if len(known) >= MIN_POSITIONS else "GPS position"
        text = f"{used} of {photos} photos have a {what}; {MIN_POSITIONS} are needed."
        hint = "Use photos as they come from the camera, with its location switched on."
        raise DatasetError(text, hint)


def _origin(places: np.ndarray) -> GeoPoint:
    """Return the median place of (n, 3), also across the date line."""
    first = places[0, 1]
    longitude = first + np.median((places[:, 1] - first + 180.0) % 360.0 - 180.0)
    longitude = (longitude + 180.0) % 360.0 - 180.0
    latitude, altitude = np.median(places[:, 0]), np.median(places[:, 2])
    return GeoPoint(float(latitude), float(longitude), float(altitude))


def _doubt(fit: RobustFit, needs: Needs) -> str:
    """Return what a fit lacks, or an empty text."""
    if fit.scale_error > needs.scale_error or fit.reach < needs.reach_sigmas * fit.sigma:
        return (
            f"The cameras are spread over {fit.reach:.2g} m, too little for an error of the GPS "
            f"positions of {fit.sigma:.2g} m."
        )
    if fit.tilt_error_deg > needs.tilt_deg or fit.lever < needs.lever_sigmas * fit.sigma:
        return (
            f"The cameras lie almost on one line: they are spread over {fit.lever:.2g} m beside "
            f"it, too little for an error of the GPS positions of {fit.sigma:.2g} m."
        )
    return ""
