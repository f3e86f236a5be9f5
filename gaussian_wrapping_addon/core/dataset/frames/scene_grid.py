# SPDX-License-Identifier: GPL-3.0-or-later
"""Round the scene to a grid, so that every similarity of an input gives the same bits.

Training amplifies the last digit of its input: a scene that is scaled or moved has other rounding
errors, and would get another mesh (docs/method.md, section 1.7). The steps below are far coarser
than rounding errors of float64 in the input and far finer than the errors of solved cameras.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ..camera import Camera
from ..quaternion import quaternion_from_rotation, rotation_from_quaternion

CENTER_STEP = 2.0**-17
"""Step of camera centres in scene units. Moves a camera by at most 7e-6: 0.01 pixels for a focal
length of 4000 pixels and a distance of 3. Models in UTM coordinates have errors of 1e-9."""

POINT_STEP = 2.0**-13
"""Step of sparse points in scene units: at most 1e-4 off, 0.03 pixels for a focal length of 1000
pixels and a distance of 3. There are many points, and training only starts from them."""

FRAME_STEP = 2.0**-20
"""Step of the quaternion of the scene's axes: they follow from camera centres, whose errors are
larger than those of rotations. Tilts the scene by at most 2e-6."""

ROTATION_STEP = 2.0**-30
"""Step of the quaternions of cameras: at most 2e-9; rounding errors are 1e-15."""

LENGTH_BITS = 16
"""Significant bits of a requested length in scene units: at most 1e-5 of it off."""


def snapped(values: np.ndarray, step: float) -> np.ndarray:
    """Return the nearest multiples of ``step``, exactly; a power of two."""
    return np.rint(np.asarray(values, np.float64) / step) * step + 0.0  # no negative zeros


def snapped_rotation(rotation: np.ndarray, step: float) -> np.ndarray:
    """Return the (3, 3) rotation of a quaternion rounded to multiples of ``step``."""
    near = rotation_from_quaternion(snapped(quaternion_from_rotation(rotation), step))
    assert near is not None  # its norm is 1 up to the step
    return near


def snapped_camera(camera: Camera) -> Camera:
    """Return a camera of the scene frame with centre and rotation on the grid."""
    rotation = snapped_rotation(camera.rotation, ROTATION_STEP)
    center = snapped(camera.center, CENTER_STEP)
    pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
    return dataclasses.replace(camera, cam_from_world=pose)


def snapped_length(length: float) -> float:
    """Return a length in scene units, rounded to :data:`LENGTH_BITS` significant bits."""
    fraction, exponent = math.frexp(length)
    return math.ldexp(round(math.ldexp(fraction, LENGTH_BITS)), exponent - LENGTH_BITS)
