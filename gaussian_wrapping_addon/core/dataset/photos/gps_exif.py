# SPDX-License-Identifier: GPL-3.0-or-later
"""Read where a photo was taken from its EXIF: GPS latitude, longitude and altitude."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .image_formats import open_image, without_warnings

_GPS_FOLDER = 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE = 1, 2, 3, 4
_ALTITUDE_REF, _ALTITUDE, _STATUS, _DOP, _DATUM, _ERROR_M = 5, 6, 9, 11, 18, 31
_SIGNS = {"N": 1.0, "S": -1.0, "E": 1.0, "W": -1.0}
_VOID = "V"
"""GPSStatus of a receiver without a fix."""
_ALTITUDES = {
    0: (1.0, "sea level"), 1: (-1.0, "sea level"),
    2: (1.0, "ellipsoid"), 3: (-1.0, "ellipsoid"),
}  # fmt: skip
_MAX_ALTITUDE_M = 1e5
"""Beyond it, up or down, the number is no altitude of a camera."""


@dataclass(frozen=True)
class GpsPosition:
    """Where the camera says that it was."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    altitude_reference: str = "sea level"
    """``"sea level"`` or ``"ellipsoid"``, as EXIF says; cameras often measure neither exactly."""
    dop: float | None = None
    """Dilution of precision, where the receiver wrote it."""
    error_m: float | None = None
    """Horizontal error that the receiver states, where it does."""
    datum: str = ""
    """Such as ``"WGS-84"``; empty where EXIF names none."""


def read_gps_exif(path: Path) -> GpsPosition | None:
    """Return the position in a photo's EXIF, None without a valid one; never raises on bad EXIF."""
    from PIL import Image

    try:
        with without_warnings(), open_image(path) as image:
            tags: dict[int, Any] = dict(image.getexif().get_ifd(_GPS_FOLDER))
    except (OSError, ValueError, SyntaxError, TypeError, KeyError, Image.DecompressionBombError):
        return None
    return gps_of_tags(tags)


def gps_of_tags(tags: Mapping[int, Any]) -> GpsPosition | None:
    """Return the position of the GPS tags, by number, or None."""
    latitude = _degrees(tags.get(_LATITUDE), tags.get(_LATITUDE_REF), 90.0)
    longitude = _degrees(tags.get(_LONGITUDE), tags.get(_LONGITUDE_REF), 180.0)
    if latitude is None or longitude is None or _word(tags.get(_STATUS)) == _VOID:
        return None
    if latitude == 0.0 and longitude == 0.0:
        return None  # what receivers without a fix write
    reference = tags.get(_ALTITUDE_REF)
    code = reference[0] if isinstance(reference, bytes) and reference else reference
    sign, level = _ALTITUDES.get(code if isinstance(code, int) else 0, _ALTITUDES[0])
    altitude = _finite(tags.get(_ALTITUDE))
    if altitude is not None and abs(altitude) > _MAX_ALTITUDE_M:
        altitude = None
    return GpsPosition(
        latitude,
        longitude,
        None if altitude is None else sign * altitude,
        level,
        _positive(tags.get(_DOP)),
        _positive(tags.get(_ERROR_M)),
        str(tags.get(_DATUM, "")).strip("\0 ")[:40],
    )


def _degrees(value: Any, reference: Any, most: float) -> float | None:
    """Return signed degrees of (degrees, minutes, seconds), which may leave out the last ones."""
    sign = _SIGNS.get(_word(reference)[:1])
    parts = list(value) if isinstance(value, (tuple, list)) else [value]
    if sign is None or not 1 <= len(parts) <= 3:
        return None
    total = 0.0
    for part, unit in zip(parts, (1.0, 60.0, 3600.0), strict=False):
        number = _finite(part)
        if number is None or number < 0.0:
            return None
        total += number / unit
    return sign * total if total <= most else None


def _word(value: Any) -> str:
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value or "")
    return text.strip("\0 ").upper()


def _finite(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: Any) -> float | None:
    number = _finite(value)
    return number if number is not None and number > 0.0 else None
