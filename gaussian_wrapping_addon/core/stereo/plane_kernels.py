# SPDX-License-Identifier: GPL-3.0-or-later
"""Plane hypotheses in compiled code (docs/method.md, section 11.1).

A hypothesis of a pixel is a plane, written as inverse depth, which is affine in the pixel:
``1 / z(u + du, v + dv) = w + a du + b dv``. Pixels have their centres at whole numbers here.

Two views are joined by the 12 numbers of a row of ``maps``: the point at pixel (u, v) with inverse
depth w lies at ``M (u, v, 1) + w k`` in homogeneous pixels of the other view, M row by row, then k.
``lens`` is (4,): fx, fy, cx, cy.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..kernels.compiled import part

F32 = np.float32
ZERO, ONE, TWO, HALF = F32(0), F32(1), F32(2), F32(0.5)

NEAREST_Z = F32(1e-6)
"""Least homogeneous depth, relative to that in the first view, in front of the other camera."""
MAX_BACK_ERROR_PX = F32(3)
"""Largest forward-backward error that counts; occluded pixels have larger ones."""


@part(fast=True)
def random_share(state: Any) -> Any:
    """Return the next number in [0, 1) of a xorshift generator; ``state`` is (1,) uint32."""
    x = state[0]
    x ^= np.uint32(x << np.uint32(13))
    x ^= x >> np.uint32(17)
    x ^= np.uint32(x << np.uint32(5))
    state[0] = x
    return F32(x >> np.uint32(8)) * F32(1 / 16777216)


@part(fast=True)
def normal_of(u: Any, v: Any, w: Any, a: Any, b: Any, lens: Any) -> Any:
    """Return the unit normal away from the camera (3 values), and its cosine with the ray."""
    nx, ny = a * lens[0], b * lens[1]
    nz = w - a * (u - lens[2]) - b * (v - lens[3])
    rx, ry = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    cosine = w / (length * np.sqrt(rx * rx + ry * ry + ONE))
    return nx / length, ny / length, nz / length, cosine


@part(fast=True)
def slopes_of(u: Any, v: Any, w: Any, nx: Any, ny: Any, nz: Any, lens: Any) -> Any:
    """Return (a, b) of the plane through a pixel's point with a normal away from the camera."""
    rx, ry = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
    scale = w / (nx * rx + ny * ry + nz)
    return nx * scale / lens[0], ny * scale / lens[1]


@part(fast=True)
def back_error_px(
    s: Any, u: Any, v: Any, x: Any, y: Any, back_maps: Any, inverse_depths: Any, base: Any,
    stride: Any,
) -> Any:  # fmt: skip
    """Return how far from (u, v) the other view's own depth at (x, y) lands, pixels.

    At most :data:`MAX_BACK_ERROR_PX`, also where that view has no depth.
    """
    column, row = np.int32(x + HALF), np.int32(y + HALF)
    w = inverse_depths[base + np.uint64(row * np.int32(stride) + column)]
    if w <= ZERO:
        return MAX_BACK_ERROR_PX
    m = back_maps[s]
    z = m[6] * x + m[7] * y + m[8] + w * m[11]
    if z <= NEAREST_Z:
        return MAX_BACK_ERROR_PX
    dx = (m[0] * x + m[1] * y + m[2] + w * m[9]) / z - u
    dy = (m[3] * x + m[4] * y + m[5] + w * m[10]) / z - v
    return min(np.sqrt(dx * dx + dy * dy), MAX_BACK_ERROR_PX)
