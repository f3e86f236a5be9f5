# SPDX-License-Identifier: GPL-3.0-or-later
"""Real spherical harmonics up to degree 3 and their gradient, over blocks of directions.

Order and signs are those of 3D Gaussian splatting files (Condon-Shortley phase): the bands are
``1``, ``-y z -x``, then degree 2 and 3 with ``m`` from ``-l`` to ``l``. All degrees are always
evaluated: a few dozen packed operations, cheaper than branching.
"""

from __future__ import annotations

import math
from typing import Any

from ...kernels.compiled import inline
from .projection_math import BLOCK

MAX_DEGREE = 3
BASIS_COUNT = (MAX_DEGREE + 1) ** 2

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


@inline
def write_basis(m: Any, at: Any, lane: Any, x: Any, y: Any, z: Any) -> None:
    """Write the 16 basis values at the unit direction (x, y, z) to the planes from ``at`` on."""
    xx, yy, zz = x * x, y * y, z * z
    m[at + lane] = _C0
    m[at + 1 * BLOCK + lane] = -_C1 * y
    m[at + 2 * BLOCK + lane] = _C1 * z
    m[at + 3 * BLOCK + lane] = -_C1 * x
    m[at + 4 * BLOCK + lane] = _C2A * x * y
    m[at + 5 * BLOCK + lane] = -_C2A * y * z
    m[at + 6 * BLOCK + lane] = _C2B * (2.0 * zz - xx - yy)
    m[at + 7 * BLOCK + lane] = -_C2A * x * z
    m[at + 8 * BLOCK + lane] = _C2C * (xx - yy)
    m[at + 9 * BLOCK + lane] = -_C3A * y * (3.0 * xx - yy)
    m[at + 10 * BLOCK + lane] = _C3B * x * y * z
    m[at + 11 * BLOCK + lane] = -_C3C * y * (4.0 * zz - xx - yy)
    m[at + 12 * BLOCK + lane] = _C3D * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    m[at + 13 * BLOCK + lane] = -_C3C * x * (4.0 * zz - xx - yy)
    m[at + 14 * BLOCK + lane] = _C3E * z * (xx - yy)
    m[at + 15 * BLOCK + lane] = -_C3A * x * (xx - 3.0 * yy)


@inline
def direction_gradient(m: Any, at: Any, lane: Any, x: Any, y: Any, z: Any) -> Any:
    """Return the gradient with respect to (x, y, z) of a weighted sum of basis functions.

    The 16 weights are in the planes from ``at`` on. x, y and z are treated as independent; the
    caller projects onto the sphere's tangent plane.
    """
    xx, yy, zz = x * x, y * y, z * z
    w4, w5 = _C2A * m[at + 4 * BLOCK + lane], -_C2A * m[at + 5 * BLOCK + lane]
    w6, w7 = 2.0 * _C2B * m[at + 6 * BLOCK + lane], -_C2A * m[at + 7 * BLOCK + lane]
    w8 = 2.0 * _C2C * m[at + 8 * BLOCK + lane]
    w9, w10 = 3.0 * _C3A * m[at + 9 * BLOCK + lane], _C3B * m[at + 10 * BLOCK + lane]
    w11, w12 = _C3C * m[at + 11 * BLOCK + lane], _C3D * m[at + 12 * BLOCK + lane]
    w13, w14 = _C3C * m[at + 13 * BLOCK + lane], _C3E * m[at + 14 * BLOCK + lane]
    w15 = 3.0 * _C3A * m[at + 15 * BLOCK + lane]
    gx = -_C1 * m[at + 3 * BLOCK + lane] + w4 * y + w7 * z + (w8 - w6) * x
    gy = -_C1 * m[at + 1 * BLOCK + lane] + w4 * x + w5 * z - (w8 + w6) * y
    gz = _C1 * m[at + 2 * BLOCK + lane] + w5 * y + w7 * x + 2.0 * w6 * z
    xy = 2.0 * x * y
    gx += w10 * y * z - w9 * xy + w11 * xy - 6.0 * w12 * x * z
    gx += 2.0 * w14 * x * z - w13 * (4.0 * zz - 3.0 * xx - yy) - w15 * (xx - yy)
    gy += w10 * x * z - w9 * (xx - yy) - w11 * (4.0 * zz - xx - 3.0 * yy) - 6.0 * w12 * y * z
    gy += w13 * xy - 2.0 * w14 * y * z + w15 * xy
    gz += w10 * x * y - 8.0 * z * (w11 * y + w13 * x)
    gz += w12 * (6.0 * zz - 3.0 * xx - 3.0 * yy) + w14 * (xx - yy)
    return gx, gy, gz
