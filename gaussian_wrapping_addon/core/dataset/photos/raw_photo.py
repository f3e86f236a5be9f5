# SPDX-License-Identifier: GPL-3.0-or-later
"""Develop RAW photos of cameras with LibRaw (rawpy), all of a set in the same way.

White balance is the camera's. Nothing depends on what a photo shows: neither its brightness nor
its white level are stretched, so that exposures of a set stay comparable. The colours are sRGB,
with the camera's orientation applied. It comes out darker than the camera's own JPEG.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import MissingExtraError
from ...processes.worker_extras import load_extra
from .image_formats import RAW

_SRGB_GAMMA = (2.4, 12.92)
"""Exponent and slope at black; LibRaw's default is that of television."""
_TURNED = (4, 5, 6, 7)
"""LibRaw's codes of orientations that exchange width and height."""
_one_at_a_time = threading.Lock()
"""Developing takes some 30 bytes a pixel, and uses all cores by itself."""


def raw_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a RAW photo once it is developed, without reading its pixels.

    Raises
    ------
    MissingExtraError
        The worker has no package for RAW photos.
    ValueError
        Not a RAW photo that LibRaw knows.
    """
    with _opened(path) as raw:
        sizes = raw.sizes
        width, height = int(sizes.iwidth), int(sizes.iheight)
        return (height, width) if sizes.flip in _TURNED else (width, height)


def develop(path: Path, *, half: bool = False) -> np.ndarray:
    """Develop a RAW photo.

    Parameters
    ----------
    path : Path
    half : bool
        At half the size: each 2 x 2 block of the sensor gives one pixel, several times faster.

    Returns
    -------
    (h, w, 3) uint8
        Upright, sRGB.

    Raises
    ------
    MissingExtraError
        The worker has no package for RAW photos.
    ValueError
        Not a RAW photo that LibRaw knows, or damaged.
    """
    with _one_at_a_time, _opened(path) as raw:
        return np.ascontiguousarray(
            raw.postprocess(
                use_camera_wb=True,
                no_auto_bright=True,
                adjust_maximum_thr=0.0,  # else the brightest pixel of a photo may become white
                gamma=_SRGB_GAMMA,
                output_bps=8,
                half_size=half,
            )
        )


def raw_focal(path: Path) -> tuple[float, str]:
    """Return focal length in mm (0 where unknown) and name of the lens, as LibRaw reads them.

    Raises
    ------
    MissingExtraError, ValueError
        As :func:`raw_size`.
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
