# SPDX-License-Identifier: GPL-3.0-or-later
"""Rotations from quaternions and back, in float64."""

from __future__ import annotations

import numpy as np

from ..tolerances import QUATERNION_MIN_NORM


def rotation_from_quaternion(quaternion: np.ndarray) -> np.ndarray | None:
    """Return the (3, 3) rotation of a Hamilton quaternion w x y z; ``None`` if zero or NaN."""
    q = np.asarray(quaternion, np.float64)
    largest = np.abs(q).max()
    if not np.isfinite(q).all() or largest < QUATERNION_MIN_NORM:
        return None
    q = q / largest  # the squares of a huge quaternion would overflow
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion w x y z (w >= 0) of a (3, 3) rotation.

    The largest eigenvector of Bar-Itzhack's symmetric matrix: no case distinction, no loss of
    precision near half turns.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, np.float64)
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quaternion = np.linalg.eigh(matrix)[1][:, -1]
    return quaternion if quaternion[0] >= 0 else -quaternion
