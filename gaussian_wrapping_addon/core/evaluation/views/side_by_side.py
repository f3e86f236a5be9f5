# SPDX-License-Identifier: GPL-3.0-or-later
"""Write two images of the same size side by side."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ...errors import ResourceError
from ...files import write_bytes
from .textured_rendering import BACKGROUND

GAP_PX = 12
JPEG_QUALITY = 88


def write_side_by_side(
    path: Path, left: np.ndarray, right: np.ndarray, *, max_width_px: int | None = None
) -> None:
    """Write a PNG or JPEG, depending on the path's suffix.

    Parameters
    ----------
    path : Path
        Its folder must exist.
    left, right : (h, w, 3) uint8
    max_width_px : int, optional
        A wider picture is scaled down.

    Raises
    ------
    ResourceError
        The file cannot be written.
    """
    from PIL import Image

    height, width = left.shape[:2]
    canvas = np.empty((height, 2 * width + GAP_PX, 3), np.uint8)
    canvas[:] = BACKGROUND
    canvas[:, :width] = left
    canvas[:, width + GAP_PX :] = right
    picture = Image.fromarray(canvas)
    if max_width_px is not None and picture.width > max_width_px:
        low = max(1, round(height * max_width_px / picture.width))
        picture = picture.resize((max_width_px, low), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    if path.suffix == ".png":
        picture.save(stream, format="PNG")
    else:
        picture.save(stream, format="JPEG", quality=JPEG_QUALITY)
    try:
        write_bytes(path, stream.getvalue())
    except OSError as error:
        raise ResourceError(
            f"{path} cannot be written: {error.strerror or error}.",
            "Check that the folder exists, is not read-only, and that the disk has room.",
        ) from error
