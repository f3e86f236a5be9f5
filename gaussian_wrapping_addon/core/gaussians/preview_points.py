# SPDX-License-Identifier: GPL-3.0-or-later
"""Points that show a running training in a 3D view: centres and colours of its Gaussians.

NumPy only, so that Blender can load it.
"""

from __future__ import annotations

import io
import math
from typing import Final

import numpy as np

POINTS_FILE: Final = "preview-points.npy"
POINT: Final = np.dtype([("position", "<f4", (3,)), ("color", "u1", (4,))])
"""Scene frame; sRGB with opacity: 16 bytes a point."""
MOST_POINTS: Final = 50_000
"""Show a surface as well as all of them would, and are read in milliseconds."""
MAX_POINTS_BYTES: Final = MOST_POINTS * POINT.itemsize + 4096
"""Of a file: the points and NumPy's header."""
VISIBLE_OPACITY: Final = 0.1
"""Fainter Gaussians are mist that would hide the others."""
_SH_C0: Final = 0.5 / math.sqrt(math.pi)
"""The constant harmonic."""


def preview_points(means: np.ndarray, opacity_logits: np.ndarray, sh: np.ndarray) -> np.ndarray:
    """Return at most :data:`MOST_POINTS` of type :data:`POINT`, evenly chosen of visible Gaussians.

    Means are (n, 3), scene frame; the constant ones of the (n, k, 3) harmonics are the colours.
    """
    logit = math.log(VISIBLE_OPACITY / (1.0 - VISIBLE_OPACITY))
    seen = np.flatnonzero((opacity_logits > logit) & np.isfinite(means).all(1))
    if len(seen) > MOST_POINTS:
        seen = seen[np.linspace(0, len(seen) - 1, MOST_POINTS).astype(np.int64)]
    points = np.zeros(len(seen), POINT)
    points["position"] = means[seen]
    colors = np.nan_to_num(0.5 + _SH_C0 * sh[seen, 0])  # (m, 3)
    points["color"][:, :3] = np.rint(255.0 * np.clip(colors, 0.0, 1.0))
    points["color"][:, 3] = 255
    return points


def points_file(points: np.ndarray) -> bytes:
    """Return the bytes of a NumPy file of :func:`preview_points`."""
    stream = io.BytesIO()
    np.save(stream, points, allow_pickle=False)
    return stream.getvalue()


def parse_points(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (m, 3) and colours (m, 4), float32 from 0 to 1, of a file's bytes.

    Raises
    ------
    ValueError
        The file holds something else, too many points, or a position that is not finite.
    Exception
        NumPy raises many types for bytes that are no array.
    """
    points = np.load(io.BytesIO(data), allow_pickle=False)
    if not isinstance(points, np.ndarray) or points.dtype != POINT or points.ndim != 1:
        raise ValueError("not an array of points")
    if len(points) > MOST_POINTS or not np.isfinite(points["position"]).all():
        raise ValueError("too many points, or one that is not finite")
    positions = np.ascontiguousarray(points["position"])
    return positions, points["color"].astype(np.float32) / np.float32(255.0)
