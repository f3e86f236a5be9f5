# SPDX-License-Identifier: GPL-3.0-or-later
"""Read size, EXIF orientation and projection of a photo from its header, without decoding it.

JPEG and PNG are parsed here, so that a Python with numpy alone (Blender's) can check an input;
other formats are read by Pillow and the worker's extras if these are installed.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ... import limits
from ...errors import DatasetError, MissingExtraError
from .image_formats import HEIF, RAW, open_image, photo_kind, without_warnings
from .raw_photo import raw_size

_EXIF_ORIENTATION = 0x0112
_JPEG_SIZES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_MAX_SEGMENTS = 4096
_JPEG_XMP, _PNG_XMP = b"http://ns.adobe.com/xap/1.0/\0", b"XML:com.adobe.xmp\0"
_PROJECTION = re.compile(rb"GPano:ProjectionType\s*(?:=\s*[\"']|>)\s*([A-Za-z]{1,40})")
"""In XMP, as an attribute or an element; XML is not parsed for one word."""
_ANOTHER = "Export it again as JPEG or PNG, or remove it."


@dataclass(frozen=True)
class PhotoHeader:
    """Stored size in pixels and EXIF orientation (1 to 8, 1 = as stored)."""

    width: int
    height: int
    orientation: int = 1
    projection: str = ""
    """Of a panorama, as JPEG and PNG say it in XMP (``GPano:ProjectionType``), in lower case."""

    @property
    def upright_size(self) -> tuple[int, int]:
        """(width, height) after the EXIF orientation is applied."""
        if self.orientation >= 5:
            return (self.height, self.width)
        return (self.width, self.height)


def read_photo_header(path: Path) -> PhotoHeader | None:
    """Read the header of a photo.

    Returns
    -------
    PhotoHeader or None
        ``None`` where the format needs Pillow or an extra that is not installed.

    Raises
    ------
    DatasetError
        Not a regular file, no image, or larger than the limits.
    """
    if not path.is_file():
        raise DatasetError(f"{path.name} is not a file.", "Remove the name or restore the photo.")
    try:
        with path.open("rb") as stream:
            magic = stream.read(8)
            stream.seek(0)
            if magic.startswith(b"\xff\xd8"):
                header = _read_jpeg(stream)
            elif magic == b"\x89PNG\r\n\x1a\n":
                header = _read_png(stream)
            else:
                other = _read_other(path)
                if other is None:
                    return None
                header = other
    except PermissionError as error:
        raise DatasetError(
            f"{path.name} cannot be read: {error.strerror}.", "Check its permissions."
        ) from None
    except (OSError, ValueError, struct.error, SyntaxError, OverflowError) as error:
        reason = str(error) or type(error).__name__
        raise DatasetError(f"{path.name} is not a readable photo ({reason}).", _ANOTHER) from None
    side, pixels = limits.MAX_IMAGE_SIDE_PX, limits.MAX_IMAGE_PIXELS
    if not (0 < header.width <= side and 0 < header.height <= side):
        raise DatasetError(
            f"{path.name} is {header.width} x {header.height} pixels; the limit is {side} a side.",
            "Scale it down.",
        )
    if header.width * header.height > pixels:
        raise DatasetError(
            f"{path.name} has {header.width} x {header.height} pixels; the limit is {pixels}.",
            "Scale it down.",
        )
    return header


def _read_jpeg(stream: IO[bytes]) -> PhotoHeader:
    stream.read(2)
    orientation, projection = 1, ""
    for _ in range(_MAX_SEGMENTS):
        byte = stream.read(1)
        while byte and byte != b"\xff":
            byte = stream.read(1)
        while byte == b"\xff":
            byte = stream.read(1)
        if not byte:
            raise ValueError("the file ends before the picture")
        marker = byte[0]
        if marker == 0x01 or 0xD0 <= marker <= 0xD8:
            continue
        if marker in (0xD9, 0xDA):
            raise ValueError("the picture begins before its size is given")
        (length,) = struct.unpack(">H", stream.read(2))
        if length < 2:
            raise ValueError("a segment is shorter than its own length")
        if marker in _JPEG_SIZES:
            _, height, width = struct.unpack(">BHH", stream.read(5))
            return PhotoHeader(width, height, orientation, projection)
        body = stream.read(length - 2)
        if len(body) < length - 2:
            raise ValueError("the file ends inside its header")
        if marker == 0xE1 and body.startswith(b"Exif\0\0"):
            orientation = _exif_orientation(body[6:])
        elif marker == 0xE1 and body.startswith(_JPEG_XMP):
            projection = _xmp_projection(body)
    raise ValueError("the header has too many segments")


def _read_png(stream: IO[bytes]) -> PhotoHeader:
    stream.seek(8)
    length, kind = struct.unpack(">I4s", stream.read(8))
    if kind != b"IHDR" or length != 13:
        raise ValueError("the first chunk is not IHDR")
    body = stream.read(13)
    (crc,) = struct.unpack(">I", stream.read(4))
    if zlib.crc32(kind + body) != crc:
        raise ValueError("the header's checksum is wrong")
    width, height = struct.unpack(">II", body[:8])
    orientation, projection = 1, ""
    for _ in range(_MAX_SEGMENTS):
        head = stream.read(8)
        if len(head) < 8:
            break
        length, kind = struct.unpack(">I4s", head)
        if kind in (b"IDAT", b"IEND"):
            break
        if kind in (b"eXIf", b"iTXt") and length <= limits.MAX_LINE_BYTES:
            body = stream.read(length)
            if kind == b"eXIf":
                orientation = _exif_orientation(body)
            elif body.startswith(_PNG_XMP):
                projection = _xmp_projection(body)
            length = 0
        stream.seek(length + 4, 1)
    return PhotoHeader(width, height, orientation, projection)


def _xmp_projection(body: bytes) -> str:
    found = _PROJECTION.search(body)
    return found[1].decode().lower() if found else ""


def _exif_orientation(body: bytes) -> int:
    """Return the orientation in a TIFF block; 1 ("as stored") if it is missing or invalid."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(body[:4])
    if order is None:
        return 1
    try:
        (at,) = struct.unpack_from(f"{order}I", body, 4)
        (entries,) = struct.unpack_from(f"{order}H", body, at)
        for i in range(entries):
            tag, _, _, value = struct.unpack_from(f"{order}HHIH", body, at + 2 + 12 * i)
            if tag == _EXIF_ORIENTATION:
                return value if 1 <= value <= 8 else 1
    except struct.error:
        return 1
    return 1


def _read_other(path: Path) -> PhotoHeader | None:
    kind = photo_kind(path)
    try:
        if kind == RAW:
            return PhotoHeader(*raw_size(path))
        from PIL import Image, UnidentifiedImageError
    except (ImportError, MissingExtraError):
        return None
    try:
        with without_warnings(), open_image(path) as image:
            width, height = image.size
            # These are turned upright when they are opened, size included.
            if image.format == "TIFF" or kind == HEIF:
                return PhotoHeader(width, height)
            orientation = image.getexif().get(_EXIF_ORIENTATION, 1)
    except MissingExtraError:
        return None
    except (UnidentifiedImageError, Image.DecompressionBombError):
        raise ValueError("it is no JPEG, PNG, TIFF, WebP, BMP, AVIF or HEIC") from None
    valid = isinstance(orientation, int) and 1 <= orientation <= 8
    return PhotoHeader(width, height, int(orientation) if valid else 1)
