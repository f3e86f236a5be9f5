# SPDX-License-Identifier: GPL-3.0-or-later
"""Formats of photos: headers read with bounds, decoders, RAW."""

from __future__ import annotations

import contextlib
import functools
import re
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from .. import limits
from ..errors import DatasetError, MissingExtraError
from ..worker.environment import load_extra, load_extras

if TYPE_CHECKING:
    from PIL import Image


# -- Tell formats of photos apart by their content, and open images with Pillow in these only -----
#
# Pillow goes by the content of a file, not by its name, and knows some forty formats: a
# PostScript file named ``.jpg`` would start Ghostscript.

IMAGE_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "AVIF")
"""Pillow's names; a JPEG with several pictures (MPO) is opened as JPEG."""
PLAIN_FORMATS = IMAGE_FORMATS[:5]
"""Those that Blender and other programs read as well."""

IMAGE, HEIF, RAW = "image", "heif", "raw"
"""Kinds of photo files. The last two need the extra of that name in the worker."""
PLAIN_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".avif")
HEIF_SUFFIXES = (".heic", ".heif", ".hif")
RAW_SUFFIXES = (
    ".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".srf", ".raf", ".orf",
    ".rw2", ".rwl", ".pef", ".srw", ".x3f", ".3fr", ".fff", ".iiq", ".erf", ".kdc", ".dcr",
    ".mrw", ".mos", ".mef", ".raw",
)  # fmt: skip
PHOTO_SUFFIXES = PLAIN_SUFFIXES + HEIF_SUFFIXES + RAW_SUFFIXES
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
_AVIF_BRANDS = (b"avif", b"avis")
_BRAND_BYTES = 64
"""Of an ISO media file, in which its brands are looked for."""
_NAMED_FILES = 3
"""Files that an error of a missing extra names."""


def photo_kind(path: Path) -> str:
    """Return ``IMAGE``, ``HEIF`` or ``RAW``.

    HEIF is told by the content (phones' files are often renamed), RAW by the name unless the
    content is something else: many RAW formats are TIFF inside.

    Raises OSError: the file cannot be read, or is a pipe or a device, which reading could wait for.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file.")
    with path.open("rb") as stream:
        head = stream.read(_BRAND_BYTES)
    if head[4:8] == b"ftyp":
        if any(brand in head[8:] for brand in _AVIF_BRANDS):
            return IMAGE
        if head[8:12] in _HEIF_BRANDS:
            return HEIF
    is_image = head.startswith((b"\xff\xd8", b"\x89PNG"))
    return RAW if path.suffix.lower() in RAW_SUFFIXES and not is_image else IMAGE


def require_extras(photos: Sequence[Path]) -> None:
    """Raise where the worker lacks the packages that photos need; decodes nothing.

    Raises MissingExtraError, which names the photos and the next step.
    """
    of_kind: dict[str, list[str]] = {}
    for path in photos:
        with contextlib.suppress(OSError):  # reported where the photo is read
            of_kind.setdefault(photo_kind(path), []).append(path.name)
    needed_by = {}
    for kind, names in of_kind.items():
        if kind != IMAGE:
            more = len(names) - _NAMED_FILES
            others = f" and {more} other{'s' * (more > 1)}" if more > 0 else ""
            needed_by[kind] = ", ".join(names[:_NAMED_FILES]) + others
    load_extras(needed_by)


def open_image(path: Path) -> Image.Image:
    """Open an image, whose pixels are read later; for RAW see :mod:`.formats`.

    HEIF photos come upright, their own rotation and mirroring applied.

    Raises ImportError: Pillow is not installed; MissingExtraError: a HEIF photo, and its extra is
    not installed; PIL.UnidentifiedImageError, OSError, ValueError, SyntaxError,
    DecompressionBombError: of Pillow: no image in one of :data:`IMAGE_FORMATS`.
    """
    from PIL import Image

    if photo_kind(path) == HEIF:
        load_extra(HEIF, path.name).register_heif_opener(thumbnails=False)
        return Image.open(path, formats=("HEIF",))
    return Image.open(path, formats=_formats())


@contextlib.contextmanager
def without_warnings() -> Iterator[None]:
    """Let Pillow warn of nothing on the terminal while the block opens and decodes.

    It warns of EXIF entries that are cut, and of sizes that our own check of the header allows.
    The filters belong to the process: photos are read on several threads, so that the first to
    come sets them and the last to go restores them.
    """
    global _quiet_threads
    with _quiet_lock:
        if not _quiet_threads:
            _earlier_filters.enter_context(warnings.catch_warnings())
            warnings.simplefilter("ignore")
        _quiet_threads += 1
    try:
        yield
    finally:
        with _quiet_lock:
            _quiet_threads -= 1
            if not _quiet_threads:
                _earlier_filters.close()


_quiet_lock = threading.Lock()
_quiet_threads = 0
_earlier_filters = contextlib.ExitStack()


def forbid_ghostscript() -> None:
    """Let Pillow start no Ghostscript in this process, where a library opens images itself."""
    try:
        from PIL import EpsImagePlugin
    except ImportError:
        return
    EpsImagePlugin.gs_binary = False


@functools.cache
def _formats() -> tuple[str, ...]:
    """Return the formats that this build of Pillow can read."""
    from PIL import Image

    Image.init()
    return tuple(name for name in IMAGE_FORMATS if name in Image.OPEN)


# -- Develop RAW photos of cameras with LibRaw (rawpy), all of a set in the same way --------------
#
# White balance is the camera's. Nothing depends on what a photo shows: neither its brightness nor
# its white level are stretched, so that exposures of a set stay comparable. The colours are sRGB,
# with the camera's orientation applied. It comes out darker than the camera's own JPEG.

_SRGB_GAMMA = (2.4, 12.92)
"""Exponent and slope at black; LibRaw's default is that of television."""
_TURNED = (4, 5, 6, 7)
"""LibRaw's codes of orientations that exchange width and height."""
_one_at_a_time = threading.Lock()
"""Developing takes some 30 bytes a pixel, and uses all cores by itself."""


def raw_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a RAW photo once it is developed, without reading its pixels.

    Raises MissingExtraError: the worker has no package for RAW photos; ValueError: not a RAW photo
    that LibRaw knows.
    """
    with _opened(path) as raw:
        sizes = raw.sizes
        width, height = int(sizes.iwidth), int(sizes.iheight)
        return (height, width) if sizes.flip in _TURNED else (width, height)


def develop(path: Path, *, half: bool = False) -> np.ndarray:
    """Develop a RAW photo.

    ``half``: at half the size: each 2 x 2 block of the sensor gives one pixel, several times
        faster.
    Returns (h, w, 3) uint8, upright, sRGB.
    Raises MissingExtraError: the worker has no package for RAW photos; ValueError: not a RAW photo
    that LibRaw knows, or damaged.
    """
    with _one_at_a_time, _opened(path) as raw:
        # Without the last setting the brightest pixel of a photo may become white.
        pixels = raw.postprocess(
            use_camera_wb=True, no_auto_bright=True, gamma=_SRGB_GAMMA, output_bps=8,
            half_size=half, adjust_maximum_thr=0.0,
        )  # fmt: skip
        return np.ascontiguousarray(pixels)


def raw_focal(path: Path) -> tuple[float, str]:
    """Return focal length in mm (0 where unknown) and name of the lens, as LibRaw reads them.

    Raises MissingExtraError, ValueError: as :func:`raw_size`.
    """
    with _opened(path) as raw:
        return float(raw.other.focal_length), str(raw.lens.model)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a RAW photo; errors of LibRaw become ``ValueError``."""
    rawpy = load_extra(RAW, path.name)
    try:
        # A file of ours: LibRaw takes names on Windows in the encoding of the system only.
        with path.open("rb") as stream, rawpy.imread(stream) as raw:
            yield raw
    except MissingExtraError:
        raise
    except rawpy.LibRawError as error:
        reason = error.args[0] if error.args else type(error).__name__
        text = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
        raise ValueError(f"LibRaw: {text}") from None
    except rawpy.NotSupportedError as error:
        raise ValueError(f"LibRaw: {error}") from None


# -- Read size, EXIF orientation and projection of a photo from its header, without decoding it
#
# JPEG and PNG are parsed here, so that a Python with numpy alone (Blender's) can check an input;
# other formats are read by Pillow and the worker's extras if these are installed.

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
        size = (self.width, self.height)
        return size[::-1] if self.orientation >= 5 else size


def read_photo_header(path: Path) -> PhotoHeader | None:
    """Read the header of a photo.

    Returns ``None`` where the format needs Pillow or an extra that is not installed.
    Raises DatasetError: not a regular file, no image, or larger than the limits.
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
            elif (other := _read_other(path)) is not None:
                header = other
            else:
                return None
    except PermissionError as error:
        text = f"{path.name} cannot be read: {error.strerror}."
        raise DatasetError(text, "Check its permissions.") from None
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
        text = f"{path.name} has {header.width} x {header.height} pixels; the limit is {pixels}."
        raise DatasetError(text, "Scale it down.")
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
