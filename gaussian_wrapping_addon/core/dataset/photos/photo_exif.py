# SPDX-License-Identifier: GPL-3.0-or-later
"""Read lens identity and focal length from a photo's EXIF."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .image_formats import RAW, open_image, photo_kind, without_warnings
from .raw_photo import raw_focal

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
    focal_mm, focal_35 = _positive(tags.get(_FOCAL_MM)), _positive(tags.get(_FOCAL_35MM))
    names = [str(tags.get(tag, "")).strip("\0 ")[:80] for tag in (_MAKE, _MODEL, _LENS)]
    key = (*names, f"{focal_mm:.1f}", f"{focal_35:.1f}")
    longest = max(width, height)
    focal_px = 0.0
    if focal_35:
        # The 35 mm equivalent preserves the diagonal field of view (CIPA DCG-001).
        focal_px = focal_35 * math.hypot(width, height) / _DIAGONAL_35MM
    elif focal_mm:
        unit_mm = _UNIT_MM.get(int(_positive(tags.get(_PLANE_UNIT)) or 2), 25.4)
        pixels_per_mm = _positive(tags.get(_PLANE_X)) / unit_mm
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


def _positive(value: Any) -> float:
    """Return a finite number above 0, or 0."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) and number > 0 else 0.0
