# SPDX-License-Identifier: GPL-3.0-or-later
"""From how much of a pixel shows the object to a mask of the photo."""

from __future__ import annotations

import io

import numpy as np
from scipy import ndimage

THRESHOLD = 0.5
"""Share of a pixel from which it belongs to the object."""
SMALLEST_SHARE = 0.02
"""Parts smaller than this share of the largest are floaters."""
SMALL_HOLE_SHARE = 2e-4
"""Holes up to this share of the photo are thin spots of the model."""
OPEN_SHARE = 0.3
"""Mean share of the object in a larger hole, up to which one sees through it, as under a handle.
Where the model is thin, 0.4 is usual."""
GROWN_SHARE = 0.003
"""Border kept around the object, as a share of the long side: silhouettes of a small model are a
pixel of it inexact, and what a mask cuts off is lost while what it leaves on is not
(docs/method.md, section 12.1)."""


def cleaned(share: np.ndarray, size: tuple[int, int], grown_share: float = 0.0) -> np.ndarray:
    """Return the (h, w) bool mask of a photo, true where it shows the object.

    Parameters
    ----------
    share : (h', w') float
        In [0, 1]; of the whole photo, usually smaller than it.
    size : (int, int)
        Width and height of the photo.
    grown_share : float
        Border kept around the object, as a share of the photo's long side.
    """
    from PIL import Image

    grey = Image.fromarray(np.ascontiguousarray(share, np.float32))
    whole = np.asarray(grey.resize(size, Image.Resampling.BILINEAR))
    kept = _without_thin_spots(_large_parts(whole >= THRESHOLD), whole)
    if not grown_share:
        return kept
    radius = max(1, round(grown_share * max(size)))
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return np.asarray(ndimage.binary_dilation(kept, x * x + y * y <= radius * radius))


def _large_parts(mask: np.ndarray) -> np.ndarray:
    label, count = ndimage.label(mask)
    if count < 2:
        return mask
    areas = np.bincount(label.ravel())
    areas[0] = 0
    return np.asarray((areas >= SMALLEST_SHARE * areas.max())[label] & mask)


def _without_thin_spots(mask: np.ndarray, share: np.ndarray) -> np.ndarray:
    holes = ndimage.binary_fill_holes(mask) & ~mask
    label, count = ndimage.label(holes)
    if count == 0:
        return mask
    areas = np.bincount(label.ravel())
    thin = np.bincount(label.ravel(), share.ravel()) > OPEN_SHARE * areas
    return np.asarray(mask | (holes & (thin | (areas <= SMALL_HOLE_SHARE * mask.size))[label]))


def encoded(mask: np.ndarray) -> bytes:
    """Return a (h, w) bool mask as a black and white PNG."""
    from PIL import Image

    stream = io.BytesIO()
    grey = Image.fromarray(np.where(mask, 255, 0).astype(np.uint8))
    grey.save(stream, format="PNG", compress_level=1)
    return stream.getvalue()
