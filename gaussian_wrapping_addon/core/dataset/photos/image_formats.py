# SPDX-License-Identifier: GPL-3.0-or-later
"""Open images with Pillow, in the formats of photos only.

Pillow goes by the content of a file, not by its name, and knows some forty formats: a PostScript
file named ``.jpg`` would start Ghostscript.
"""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PIL import Image

IMAGE_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP")
"""Pillow's names; a JPEG with several pictures (MPO) is opened as JPEG."""


def open_image(path: Path) -> Image.Image:
    """Open an image, whose pixels are read later.

    Raises
    ------
    ImportError
        Pillow is not installed.
    PIL.UnidentifiedImageError, OSError, ValueError, SyntaxError, DecompressionBombError
        Of Pillow: no image in one of :data:`IMAGE_FORMATS`.
    """
    from PIL import Image

    return Image.open(path, formats=_formats())


@contextlib.contextmanager
def without_warnings() -> Iterator[None]:
    """Let Pillow warn of nothing on the terminal while the block opens and decodes.

    It warns of EXIF entries that are cut, and of sizes that our own check of the header allows.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


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
