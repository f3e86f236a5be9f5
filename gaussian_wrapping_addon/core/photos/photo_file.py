# SPDX-License-Identifier: GPL-3.0-or-later
"""A photo or a mask, read from its file."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import DatasetError
from ..worker.environment import load_extra
from .formats import (
    HEIF,
    IMAGE,
    PLAIN_FORMATS,
    RAW,
    PhotoHeader,
    develop,
    open_image,
    photo_kind,
    read_photo_header,
    without_warnings,
)

if TYPE_CHECKING:
    from PIL import Image


# -- Decode one photo or mask to 8-bit arrays: any mode, any EXIF orientation, within the limits

JPEG_QUALITY = 97
"""Of written photos: no visible loss, a fifth of a PNG's size."""

MASK_THRESHOLD = 128
"""Mask pixels darker than this are ignored."""

_ANOTHER = "Export it again as JPEG or PNG, or remove it."


@dataclass(frozen=True)
class DecodedPhoto:
    """A photo as arrays."""

    color: np.ndarray
    """(h, w, 3) uint8."""
    alpha: np.ndarray | None
    """(h, w) uint8, if the file has transparency."""
    plain: bool
    """Whether every program reads exactly these pixels: 8-bit, RGB or grey, no rotation."""


def photo_header(path: Path) -> PhotoHeader:
    """Return the header of a photo; Pillow is needed for other formats than JPEG and PNG.

    Raises DatasetError: as :func:`~.formats.read_photo_header`, or Pillow is not installed;
    MissingExtraError: the worker lacks the package for HEIF or RAW.
    """
    header = read_photo_header(path)
    if header is None:
        kind = photo_kind(path)
        if kind != IMAGE:
            load_extra(kind, path.name)
        raise DatasetError(f"{path.name} needs Pillow to be read.", "Install Pillow.")
    return header


def read_photo(path: Path, *, upright: bool = True, enough_px: int = 0) -> DecodedPhoto:
    """Decode a photo.

    Parameters
    ----------
    path : Path
    upright : bool
        Apply the EXIF orientation. HEIF and RAW photos are upright always.
    enough_px : int
        If given, a RAW photo is developed at half its size where the long side of that still has
        so many pixels.

    Raises
    ------
    DatasetError
        Names the file: not an image, cut, too large.
    MissingExtraError
        The worker lacks the package for HEIF or RAW.
    """
    header = photo_header(path)
    if photo_kind(path) == RAW:
        half = bool(enough_px) and max(header.width, header.height) >= 2 * enough_px
        try:
            return DecodedPhoto(develop(path, half=half), None, False)
        except (OSError, ValueError) as error:
            raise DatasetError(f"{path.name} cannot be decoded ({error}).", _ANOTHER) from None
    image = _open(path)
    is_common = image.format in PLAIN_FORMATS
    plain = image.mode in ("RGB", "L") and header.orientation == 1 and is_common
    color, alpha = _to_arrays(image)
    if upright:
        color = apply_orientation(color, header.orientation)
        alpha = None if alpha is None else apply_orientation(alpha, header.orientation)
    return DecodedPhoto(color, alpha, plain)


def read_mask(path: Path, *, upright: bool = True) -> np.ndarray:
    """Decode a mask to (h, w) uint8; if only the alpha varies, it is the mask.

    Raises DatasetError, which names the file.
    """
    header = photo_header(path)
    color, alpha = _to_arrays(_open(path))
    grey = color.max(2)
    if alpha is not None and alpha.min() < alpha.max() and grey.min() == grey.max():
        grey = alpha
    return apply_orientation(grey, header.orientation) if upright else grey


def apply_orientation(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate and mirror stored pixels (h, w, ...) upright by the EXIF orientation, 1 to 8."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def stored_pixels(pixels: np.ndarray, orientation: int, width: int, height: int) -> np.ndarray:
    """Return where the stored photo has (n, 2) positions x, y of the upright one.

    ``width`` and ``height`` are those of the upright photo.
    """
    x, y = np.asarray(pixels, np.float64).reshape(-1, 2).T
    if orientation in (3, 4, 7, 8):
        y = height - y
    if orientation in (2, 3, 6, 7):
        x = width - x
    return np.stack([y, x] if orientation in (5, 6, 7, 8) else [x, y], 1)


def write_photo(path: Path, color: np.ndarray) -> None:
    """Write (h, w, 3) uint8 as JPEG of high quality, without metadata."""
    from PIL import Image

    Image.fromarray(color).save(path, format="JPEG", quality=JPEG_QUALITY, subsampling=0)


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write a (h, w) bool mask as a black and white PNG."""
    from PIL import Image

    Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(path, compress_level=1)


def _open(path: Path) -> Image.Image:
    from PIL import Image, UnidentifiedImageError

    try:
        # The pixels outlive the file, which is closed even where they cannot be decoded: Windows
        # lets nobody remove an open file.
        with without_warnings(), open_image(path) as image:
            image.load()
            if photo_kind(path) == HEIF:
                return in_srgb(image)
    except UnidentifiedImageError:
        raise DatasetError(f"{path.name} is not a photo that can be read.", _ANOTHER) from None
    except (
        OSError, ValueError, SyntaxError, EOFError, RuntimeError, Image.DecompressionBombError,
    ) as error:  # fmt: skip
        raise DatasetError(f"{path.name} cannot be decoded ({error}).", _ANOTHER) from None
    return image


def in_srgb(image: Image.Image) -> Image.Image:
    """Convert an image from its embedded profile to sRGB; as it is where that is not possible.

    Phones store HEIF photos in the colours of their displays (P3): taken for sRGB, they look dull.
    """
    from PIL import Image, ImageCms

    profile = image.info.get("icc_profile")
    if not profile or image.mode not in ("RGB", "RGBA"):
        return image
    try:
        theirs = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        converted = ImageCms.profileToProfile(
            image.convert("RGB"), theirs, ImageCms.createProfile("sRGB")
        )
    except (ImageCms.PyCMSError, OSError):
        return image
    assert converted is not None
    if image.mode == "RGBA":
        return Image.merge("RGBA", (*converted.split(), image.getchannel("A")))
    return converted


def _to_arrays(image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
    """Return (h, w, 3) uint8 colour and (h, w) uint8 alpha or ``None``."""
    mode = image.mode
    if mode in ("I;16", "I;16L", "I;16B", "I", "F"):
        return np.repeat(_grey_to_eight_bits(np.asarray(image))[..., None], 3, 2), None
    if mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        pixels = np.asarray(image.convert("RGBA"))
        color, alpha = (np.ascontiguousarray(part) for part in (pixels[..., :3], pixels[..., 3]))
        return color, (None if alpha.min() == 255 else alpha)
    return np.array(image if mode == "RGB" else image.convert("RGB")), None


def _grey_to_eight_bits(values: np.ndarray) -> np.ndarray:
    """Scale 16-bit, 32-bit or float grey to 8 bits: full range of 16 bits, else of the values."""
    if values.dtype.kind == "f":
        values = np.nan_to_num(np.asarray(values, np.float64))
        top = 1.0 if values.max() <= 1.0 else 255.0
        return np.clip(np.rint(values * (255.0 / top)), 0, 255).astype(np.uint8)
    wide = np.asarray(values, np.int64)
    if wide.max(initial=0) <= 255:
        return wide.clip(0, 255).astype(np.uint8)
    return ((wide.clip(0, 65535) * 255 + 32767) // 65535).astype(np.uint8)


# -- How mask files are to be understood ----------------------------------------------------------


@dataclass(frozen=True)
class MaskReading:
    """Choices for the mask files of an input; alpha channels are left as they are."""

    invert: bool = False
    """White is left out, not kept."""
    grow_px: int = 0
    """Border added to what is kept, or taken away where negative, pixels of the photo (along rows,
    columns and diagonals alike: two quick passes)."""

    def kept(self, grey: np.ndarray) -> np.ndarray:
        """Return (h, w) bool, true where the photo counts, of a mask file's (h, w) uint8."""
        kept = grey >= MASK_THRESHOLD
        if self.invert:
            kept = ~kept
        if not self.grow_px:
            return kept
        from scipy.ndimage import maximum_filter, minimum_filter

        grown = maximum_filter if self.grow_px > 0 else minimum_filter
        return np.asarray(grown(kept, 2 * abs(self.grow_px) + 1, mode="nearest"))


AS_WRITTEN = MaskReading()


def large_parts(mask: np.ndarray, smallest_share: float) -> np.ndarray:
    """Return a (h, w) bool mask without parts smaller than this share of the largest one."""
    from scipy import ndimage

    label, count = ndimage.label(mask)
    if count < 2:
        return mask
    areas = np.bincount(label.ravel())
    areas[0] = 0
    return np.asarray((areas >= smallest_share * areas.max())[label] & mask)
