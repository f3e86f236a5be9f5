# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure one photo at a reduced size: sharpness, brightness, and a small picture of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..photos.image_formats import RAW, open_image, photo_kind, without_warnings
from ..photos.photo_file import apply_orientation, photo_header, read_photo

MEASURED_PX = 1024
"""Long side that photos are measured at: about what training sees, and quick to decode."""
SMALL_PX = 96
"""Long side of the small pictures that are compared."""
_TILES = 8
"""Tiles along each side, of which those with contrast are measured."""
_BEST_TILES = 0.25
"""Share of the tiles, those with the strongest edges, that decide the sharpness."""
_SHARPER_TILES = 0.75
"""Quantile of these tiles."""
_SMOOTH = 3
"""Pixels that edges are smoothed over."""
_FLAT = 1.0
"""Root mean square difference between pixels, levels of 255, below which a tile has no edges."""
_DARKEST = 1.0 / 255.0
"""Linear light that counts as black in the logarithm."""


@dataclass(frozen=True)
class PhotoMeasures:
    """What is compared between the photos of a set."""

    name: str
    sharpness: float
    """Share of the edges that smoothing takes; NaN where the photo has none."""
    light: float
    """Mean linear light as log2, "stops"."""
    small: np.ndarray
    """(h, w) float32, levels of 255."""


def measure_photo(path: Path, name: str) -> PhotoMeasures:
    """Measure a photo.

    Raises
    ------
    DatasetError
        It cannot be decoded.
    MissingExtraError
        The worker lacks the package for HEIF or RAW.
    """
    return measure_grey(reduced_grey(path), name)


def measure_grey(grey: np.ndarray, name: str) -> PhotoMeasures:
    """Measure a photo whose (h, w) float32 grey of :func:`reduced_grey` is given."""
    linear = (grey / 255.0) ** 2.2
    light = float(np.log2(max(float(linear.mean()), _DARKEST)))
    return PhotoMeasures(name, sharpness_of(grey), light, shrunk(grey, SMALL_PX))


def reduced_grey(path: Path) -> np.ndarray:
    """Return a photo as (h, w) float32 grey of 255 levels, upright, at most ``MEASURED_PX``.

    JPEGs are decoded at a half, a quarter or an eighth of their size where that is enough.

    Raises
    ------
    DatasetError, MissingExtraError
        As :func:`~..photos.photo_file.read_photo`.
    """
    header = photo_header(path)
    long_px = max(header.width, header.height)
    if long_px >= 2 * MEASURED_PX and photo_kind(path) != RAW:
        with without_warnings():
            pixels = _drafted(path)
        if pixels is not None:
            return apply_orientation(shrunk(pixels, MEASURED_PX), header.orientation)
    color = read_photo(path, enough_px=MEASURED_PX).color
    return shrunk(np.asarray(_grey(color)), MEASURED_PX)


def _drafted(path: Path) -> np.ndarray | None:
    """Return the grey of a JPEG at a reduced size, as stored; ``None`` for other formats."""
    try:
        with open_image(path) as image:
            if image.format != "JPEG" or image.mode not in ("RGB", "L"):
                return None
            image.draft("L", (MEASURED_PX, MEASURED_PX))
            return np.asarray(image.convert("L"))
    except (OSError, ValueError, SyntaxError):
        return None  # decoded in full, which says what is wrong


def _grey(color: np.ndarray) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.fromarray(color).convert("L"))


def shrunk(grey: np.ndarray, long_px: int) -> np.ndarray:
    """Return (h, w) grey, uint8 or float, with its long side limited; float32."""
    from PIL import Image

    height, width = grey.shape
    factor = long_px / max(height, width)
    image = Image.fromarray(np.asarray(grey, np.float32))
    if factor < 1.0:
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        image = image.resize(size, Image.Resampling.BOX)
    return np.asarray(image)


def sharpness_of(grey: np.ndarray) -> float:
    """Return how much of its edges (h, w) grey loses where it is smoothed over ``_SMOOTH`` pixels.

    In 0 to 1, whatever contrast and exposure: what is blurred already loses little. The
    tiles with the strongest edges decide, and of these the sharper part, as a blurred background is
    no fault; of the two directions the softer, as a moved camera blurs one.
    """
    height, width = grey.shape
    rows, columns = height // _TILES, width // _TILES
    if min(rows, columns) < 4 * _SMOOTH:
        return float("nan")
    sharp, smooth = zip(*(_edge_energy(grey, axis, rows, columns) for axis in (0, 1)), strict=True)
    strength = smooth[0] + smooth[1]
    best = np.argsort(strength)[::-1][: round(_BEST_TILES * strength.size)]
    best = best[strength[best] > _FLAT**2]
    if not len(best):
        return float("nan")
    lost = [
        1.0 - np.sqrt(after[best] / np.maximum(before[best], 1e-6))
        for before, after in zip(sharp, smooth, strict=True)
    ]
    return float(min(np.quantile(loss, _SHARPER_TILES) for loss in lost))


def _edge_energy(
    grey: np.ndarray, axis: int, rows: int, columns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean squares of differences along an axis in each tile, before and after smoothing."""
    steps = np.diff(grey, axis=axis)
    sums = np.cumsum(steps, axis=axis, dtype=np.float64)
    ahead = [slice(None), slice(None)]
    behind = [slice(None), slice(None)]
    ahead[axis], behind[axis] = slice(_SMOOTH, None), slice(None, -_SMOOTH)
    smoothed = (sums[tuple(ahead)] - sums[tuple(behind)]) / _SMOOTH
    return _tile_means(steps**2, rows, columns), _tile_means(smoothed**2, rows, columns)


def _tile_means(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return the (tiles * tiles,) means of (h, w) values; a missing border counts as 0."""
    full = np.zeros((_TILES * rows, _TILES * columns))
    part = values[: full.shape[0], : full.shape[1]]
    full[: part.shape[0], : part.shape[1]] = part
    return full.reshape(_TILES, rows, _TILES, columns).mean((1, 3)).ravel()
