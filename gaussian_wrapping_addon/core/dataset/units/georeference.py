# SPDX-License-Identifier: GPL-3.0-or-later
"""Place solved cameras on the earth by the GPS positions of their photos."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import DatasetError
from ..camera import Camera
from ..photos.gps_exif import GpsPosition
from ..similarity import Similarity
from .geodesy import GeoPoint, enu_from_geographic
from .real_units import listed, rounded
from .robust_fit import RobustFit, robust_similarity

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
        raise DatasetError(
            "The GPS positions are spread over more than 50 km.", "Remove photos of other places."
        )
    centers, target = np.array([c.center for c in kept]), enu[~far]
    largest = max([LARGEST_ERROR_M, *(3.0 * p.error_m for p in gps if p.error_m is not None)])
    fit = robust_similarity(
        centers, target, largest_error=min(largest, 4 * LARGEST_ERROR_M), noise=GPS_NOISE_M
    )
    missing = _doubt(fit, needs)
    if missing:
        raise DatasetError(
            missing,
            "Take photos from places further apart, not all on one line; or measure a distance.",
        )
    wrong = [c.name for c, good in zip(kept, fit.used, strict=True) if not good]
    wrong += [c.name for c, out in zip(used, far, strict=True) if out]
    dops = [p.dop for p in gps if p.dop is not None]
    errors = [p.error_m for p in gps if p.error_m is not None]
    levels = {p.altitude_reference for p in gps}
    details = {
        "gps": {
            "photos": len(cameras),
            "photos_with_position": len(used),
            "used": int(fit.used.sum()),
            "left_out": listed(wrong),
            **_residuals(fit.target_from_source, centers, target, fit.used),
            "tilt_error_deg": rounded(fit.tilt_error_deg),
            "altitude_reference": levels.pop() if len(levels) == 1 else "mixed",
            "dop_median": rounded(float(np.median(dops))) if dops else None,
            "stated_error_median_m": rounded(float(np.median(errors))) if errors else None,
        }
    }
    return Georeference(
        origin, fit.target_from_source, fit.scale_error, centers, target, fit.used, details,
        _doubt(fit, GOOD),
    )  # fmt: skip


def check_positions(known: Sequence[GpsPosition], photos: int) -> None:
    """Raise :class:`DatasetError` where too few of the photos have a position with altitude."""
    used = sum(position.altitude_m is not None for position in known)
    if used < MIN_POSITIONS:
        what = "GPS altitude" if len(known) >= MIN_POSITIONS else "GPS position"
        raise DatasetError(
            f"{used} of {photos} photos have a {what}; {MIN_POSITIONS} are needed.",
            "Use photos as they come from the camera, with its location switched on.",
        )


def _origin(places: np.ndarray) -> GeoPoint:
    """Return the median place of (n, 3), also across the date line."""
    first = places[0, 1]
    longitude = first + np.median((places[:, 1] - first + 180.0) % 360.0 - 180.0)
    longitude = (longitude + 180.0) % 360.0 - 180.0
    return GeoPoint(
        float(np.median(places[:, 0])), float(longitude), float(np.median(places[:, 2]))
    )


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
