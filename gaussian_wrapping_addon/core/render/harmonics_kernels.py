# SPDX-License-Identifier: GPL-3.0-or-later
"""Real spherical harmonics up to degree 3 and their gradient, compiled.

Order and signs are those of 3D Gaussian splatting files (Condon-Shortley phase): the bands are
``1``, ``-y z -x``, then degree 2 and 3 with ``m`` from ``-l`` to ``l``.
"""

from __future__ import annotations

import math

import numpy as np

from ..compiled import kernel

MAX_DEGREE = 3

_C0 = 0.5 / math.sqrt(math.pi)
_C1 = math.sqrt(3.0 / (4.0 * math.pi))
_C2A = math.sqrt(15.0 / (4.0 * math.pi))
_C2B = math.sqrt(5.0 / (16.0 * math.pi))
_C2C = math.sqrt(15.0 / (16.0 * math.pi))
_C3A = math.sqrt(35.0 / (32.0 * math.pi))
_C3B = math.sqrt(105.0 / (4.0 * math.pi))
_C3C = math.sqrt(21.0 / (32.0 * math.pi))
_C3D = math.sqrt(7.0 / (16.0 * math.pi))
_C3E = math.sqrt(105.0 / (16.0 * math.pi))


@kernel(fast=False)
def basis(degree: int, x: float, y: float, z: float, out: np.ndarray) -> None:
    """Write the ``(degree + 1)^2`` basis values at the unit direction (x, y, z) into ``out``."""
    out[0] = _C0
    if degree < 1:
        return
    out[1] = -_C1 * y
    out[2] = _C1 * z
    out[3] = -_C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    out[4] = _C2A * x * y
    out[5] = -_C2A * y * z
    out[6] = _C2B * (2.0 * zz - xx - yy)
    out[7] = -_C2A * x * z
    out[8] = _C2C * (xx - yy)
    if degree < 3:
        return
    out[9] = -_C3A * y * (3.0 * xx - yy)
    out[10] = _C3B * x * y * z
    out[11] = -_C3C * y * (4.0 * zz - xx - yy)
    out[12] = _C3D * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    out[13] = -_C3C * x * (4.0 * zz - xx - yy)
    out[14] = _C3E * z * (xx - yy)
    out[15] = -_C3A * x * (xx - 3.0 * yy)


@kernel(fast=False)
def basis_gradient(degree: int, x: float, y: float, z: float, out: np.ndarray) -> None:
    """Write the partial derivatives of :func:`basis` into ``out (k, 3)``.

    x, y and z count as independent; the caller projects onto the sphere's tangent plane.
    """
    out[: (degree + 1) * (degree + 1)] = 0.0
    if degree < 1:
        return
    out[1, 1] = -_C1
    out[2, 2] = _C1
    out[3, 0] = -_C1
    if degree < 2:
        return
    out[4, 0], out[4, 1] = _C2A * y, _C2A * x
    out[5, 1], out[5, 2] = -_C2A * z, -_C2A * y
    out[6, 0], out[6, 1], out[6, 2] = -2.0 * _C2B * x, -2.0 * _C2B * y, 4.0 * _C2B * z
    out[7, 0], out[7, 2] = -_C2A * z, -_C2A * x
    out[8, 0], out[8, 1] = 2.0 * _C2C * x, -2.0 * _C2C * y
    if degree < 3:
        return
    xx, yy, zz = x * x, y * y, z * z
    out[9, 0], out[9, 1] = -6.0 * _C3A * x * y, -3.0 * _C3A * (xx - yy)
    out[10, 0], out[10, 1], out[10, 2] = _C3B * y * z, _C3B * x * z, _C3B * x * y
    out[11, 0] = 2.0 * _C3C * x * y
    out[11, 1] = -_C3C * (4.0 * zz - xx - 3.0 * yy)
    out[11, 2] = -8.0 * _C3C * y * z
    out[12, 0], out[12, 1] = -6.0 * _C3D * x * z, -6.0 * _C3D * y * z
    out[12, 2] = _C3D * (6.0 * zz - 3.0 * xx - 3.0 * yy)
    out[13, 0] = -_C3C * (4.0 * zz - 3.0 * xx - yy)
    out[13, 1] = 2.0 * _C3C * x * y
    out[13, 2] = -8.0 * _C3C * x * z
    out[14, 0], out[14, 1] = 2.0 * _C3E * x * z, -2.0 * _C3E * y * z
    out[14, 2] = _C3E * (xx - yy)
    out[15, 0], out[15, 1] = -3.0 * _C3A * (xx - yy), 6.0 * _C3A * x * y
