# SPDX-License-Identifier: GPL-3.0-or-later
"""What photos say of themselves: EXIF, GPS."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .formats import RAW, open_image, photo_kind, raw_focal, without_warnings

# -- Read lens identity and focal length from a photo's EXIF --------------------------------------

_EXIF_FOLDER = 0x8769
_MAKE, _MODEL, _LENS = 0x010F, 0x0110, 0xA434
_FOCAL_MM, _FOCAL_35MM = 0x920A, 0xA405
_PLANE_X, _PLANE_UNIT, _PIXELS_X = 0xA20E, 0xA210, 0xA002
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_PLAUSIBLE = (0.2, 30.0)
"""Plausible range of the focal length over the photo's long side."""


@dataclass(frozen=True)
class LensExif:
    """Identity of the lens setting and its focal length in pixels, if known."""

    key: tuple[str, ...]
    focal_px: float | None


def read_lens_exif(path: Path, width: int, height: int) -> LensExif:
    """Read the lens setting of a ``width`` x ``height`` photo; never raises on bad EXIF."""
    from PIL import Image

    try:
        tags = _raw_tags(path) if photo_kind(path) == RAW else _image_tags(path)
    except (
        OSError, ValueError, SyntaxError, TypeError, KeyError, RuntimeError,
        Image.DecompressionBombError,
    ):  # fmt: skip
        tags = {}
    focal_mm, focal_35 = (_positive(tags.get(tag)) or 0.0 for tag in (_FOCAL_MM, _FOCAL_35MM))
    names = [str(tags.get(tag, "")).strip("\0 ")[:80] for tag in (_MAKE, _MODEL, _LENS)]
    key = (*names, f"{focal_mm:.1f}", f"{focal_35:.1f}")
    longest = max(width, height)
    focal_px = 0.0
    if focal_35:
        # The 35 mm equivalent preserves the diagonal field of view (CIPA DCG-001).
        focal_px = focal_35 * math.hypot(width, height) / _DIAGONAL_35MM
    elif focal_mm:
        unit_mm = _UNIT_MM.get(int(_positive(tags.get(_PLANE_UNIT)) or 2), 25.4)
        pixels_per_mm = (_positive(tags.get(_PLANE_X)) or 0.0) / unit_mm
        stored = _positive(tags.get(_PIXELS_X)) or longest
        focal_px = focal_mm * pixels_per_mm * longest / stored
    good = _PLAUSIBLE[0] <= focal_px / longest <= _PLAUSIBLE[1]
    return LensExif(key, focal_px if good else None)


def _image_tags(path: Path) -> dict[int, Any]:
    with without_warnings(), open_image(path) as image:
        exif = image.getexif()
        return {**exif, **exif.get_ifd(_EXIF_FOLDER)}


def _raw_tags(path: Path) -> dict[int, Any]:
    """Return the tags of a RAW photo that is TIFF inside; else focal length and lens alone."""
    from PIL import Image

    tags: dict[int, Any] = {}
    not_tiff = contextlib.suppress(OSError, ValueError, SyntaxError, TypeError, KeyError)
    with not_tiff, without_warnings(), path.open("rb") as stream:
        exif = Image.Exif()
        exif.load_from_fp(stream)
        tags = {**exif, **exif.get_ifd(_EXIF_FOLDER)}
    focal_mm, lens = raw_focal(path)
    return {_FOCAL_MM: focal_mm, _LENS: lens, **tags}


# -- Read where a photo was taken from its EXIF: GPS latitude, longitude and altitude -------------

_GPS_FOLDER = 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE = 1, 2, 3, 4
_ALTITUDE_REF, _ALTITUDE, _STATUS, _DOP, _ERROR_M = 5, 6, 9, 11, 31
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
    signed = None if altitude is None else sign * altitude
    dop, error_m = _positive(tags.get(_DOP)), _positive(tags.get(_ERROR_M))
    return GpsPosition(latitude, longitude, signed, level, dop, error_m)


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
