# SPDX-License-Identifier: GPL-3.0-or-later
"""Tell formats of photos apart by their content, and open images with Pillow in these only.

Pillow goes by the content of a file, not by its name, and knows some forty formats: a PostScript
file named ``.jpg`` would start Ghostscript.
"""

from __future__ import annotations

import contextlib
import functools
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ...processes.worker_extras import load_extra, load_extras

if TYPE_CHECKING:
    from PIL import Image

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

    Raises
    ------
    OSError
        The file cannot be read, or is a pipe or a device, which reading could wait for.
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

    Raises
    ------
    MissingExtraError
        Names the photos and the next step.
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
    """Open an image, whose pixels are read later; for RAW see :mod:`.raw_photo`.

    HEIF photos come upright, their own rotation and mirroring applied.

    Raises
    ------
    ImportError
        Pillow is not installed.
    MissingExtraError
        A HEIF photo, and its extra is not installed.
    PIL.UnidentifiedImageError, OSError, ValueError, SyntaxError, DecompressionBombError
        Of Pillow: no image in one of :data:`IMAGE_FORMATS`.
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
    _quiet.enter()
    try:
        yield
    finally:
        _quiet.leave()


class _QuietFilters:
    """Filters that ignore every warning while at least one thread wants them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._wanted_by = 0
        self._earlier = contextlib.ExitStack()

    def enter(self) -> None:
        with self._lock:
            if not self._wanted_by:
                self._earlier.enter_context(warnings.catch_warnings())
                warnings.simplefilter("ignore")
            self._wanted_by += 1

    def leave(self) -> None:
        with self._lock:
            self._wanted_by -= 1
            if not self._wanted_by:
                self._earlier.close()


_quiet = _QuietFilters()


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
