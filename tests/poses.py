# SPDX-License-Identifier: GPL-3.0-or-later
"""Poses of cameras that look at something; every test's camera comes from here."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def look_at_pose(
    eye: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Return (3, 4) float64 cam_from_world of an upright camera (world Z up) at ``eye``.

    A camera that looks (nearly) straight up or down has world Y up instead.
    """
    eye = np.asarray(eye, np.float64)
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    up = [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0]
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.concatenate([rotation, -(rotation @ eye)[:, None]], 1)
