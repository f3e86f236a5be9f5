# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled activation of blocks of raw Gaussians, the first step of projection and its gradient.

Also the layout of the scratch planes that both use (``projection_math.py``).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ... import tolerances
from ...kernels.compiled import inline, part
from .harmonics_kernels import BASIS_COUNT, write_basis
from .projection_math import BLOCK, exp_parts, exp_wide

# Loaded:
MEAN = 0
QUAT = 3 * BLOCK
ORIENTATION = 7 * BLOCK
"""Direction and sign; activation normalises the direction and replaces the sign by 1 / length, or
by 0 if the length is 0."""
SCALE = 11 * BLOCK
"""Log scales; activation turns them into variances, filter included."""
LOGIT = 14 * BLOCK
FILTER = 15 * BLOCK
# Activated:
ROTATION = 16 * BLOCK
"""Rotation, row by row."""
RAW_SHARE = 25 * BLOCK
"""Ratio of the raw to the filtered variance of each axis."""
OPACITY = 28 * BLOCK
TRANSPARENCY = 29 * BLOCK
"""1 - sigmoid(logit)."""
TANH = 30 * BLOCK
SLOPE = 31 * BLOCK
"""1 - tanh^2 of the sign."""
RAY = 32 * BLOCK
"""Unit vector from the camera centre to the mean (three planes), then 1 / distance."""
BASIS = 36 * BLOCK
ACTIVATED_PLANES = 36 + BASIS_COUNT

_QUATERNION_MIN_SQ = tolerances.QUATERNION_MIN_NORM**2
_DIRECTION_MIN_NORM = tolerances.DIRECTION_MIN_NORM
# Beyond, tanh is 1 in float64.
_SIGN_END = 20.0


@inline
def load_raw(
    m: Any,
    lane: Any,
    i: Any,
    means: Any,
    log_scales: Any,
    quats: Any,
    opacity_logits: Any,
    orientation: Any,
    filter_3d: Any,
) -> None:
    """Load all raw parameters of Gaussian i except its harmonics."""
    m[MEAN + lane] = means[i, 0]
    m[MEAN + BLOCK + lane] = means[i, 1]
    m[MEAN + 2 * BLOCK + lane] = means[i, 2]
    m[QUAT + lane] = quats[i, 0]
    m[QUAT + BLOCK + lane] = quats[i, 1]
    m[QUAT + 2 * BLOCK + lane] = quats[i, 2]
    m[QUAT + 3 * BLOCK + lane] = quats[i, 3]
    m[ORIENTATION + lane] = orientation[i, 0]
    m[ORIENTATION + BLOCK + lane] = orientation[i, 1]
    m[ORIENTATION + 2 * BLOCK + lane] = orientation[i, 2]
    m[ORIENTATION + 3 * BLOCK + lane] = orientation[i, 3]
    m[SCALE + lane] = log_scales[i, 0]
    m[SCALE + BLOCK + lane] = log_scales[i, 1]
    m[SCALE + 2 * BLOCK + lane] = log_scales[i, 2]
    m[LOGIT + lane] = opacity_logits[i]
    m[FILTER + lane] = filter_3d[i]


@part(fast=False, fused=True)
def activate_block(m: np.ndarray, camera: np.ndarray) -> None:
    """Compute all planes from ``ROTATION`` on, and the variances, of a loaded block.

    ``camera (22,)`` is the packed camera of ``projection_kernels.py``.
    """
    o0, o1, o2 = camera[12], camera[13], camera[14]
    for lane in range(BLOCK):
        w, x = m[QUAT + lane], m[QUAT + BLOCK + lane]
        y, z = m[QUAT + 2 * BLOCK + lane], m[QUAT + 3 * BLOCK + lane]
        # A degenerate quaternion is the identity.
        square = w * w + x * x + y * y + z * z
        s = 2.0 / square
        s = 0.0 if square <= _QUATERNION_MIN_SQ else s
        sx, sy, sz = s * x, s * y, s * z
        wx, wy, wz = sx * w, sy * w, sz * w
        xx, xy, xz, yy, yz, zz = sx * x, sx * y, sx * z, sy * y, sy * z, sz * z
        m[ROTATION + lane] = 1.0 - (yy + zz)
        m[ROTATION + BLOCK + lane] = xy - wz
        m[ROTATION + 2 * BLOCK + lane] = xz + wy
        m[ROTATION + 3 * BLOCK + lane] = xy + wz
        m[ROTATION + 4 * BLOCK + lane] = 1.0 - (xx + zz)
        m[ROTATION + 5 * BLOCK + lane] = yz - wx
        m[ROTATION + 6 * BLOCK + lane] = xz - wy
        m[ROTATION + 7 * BLOCK + lane] = yz + wx
        m[ROTATION + 8 * BLOCK + lane] = 1.0 - (xx + yy)
    # Raw variances of the three axes, one after the other.
    for at in range(3 * BLOCK):
        m[RAW_SHARE + at] = exp_wide(2.0 * m[SCALE + at])
    for lane in range(BLOCK):
        filter_sq = m[FILTER + lane] * m[FILTER + lane]
        raw0, raw1, raw2 = (
            m[RAW_SHARE + lane],
            m[RAW_SHARE + BLOCK + lane],
            m[RAW_SHARE + 2 * BLOCK + lane],
        )
        variance0, variance1, variance2 = raw0 + filter_sq, raw1 + filter_sq, raw2 + filter_sq
        m[SCALE + lane] = variance0
        m[SCALE + BLOCK + lane] = variance1
        m[SCALE + 2 * BLOCK + lane] = variance2
        kept0, kept1, kept2 = raw0 / variance0, raw1 / variance1, raw2 / variance2
        m[RAW_SHARE + lane] = kept0
        m[RAW_SHARE + BLOCK + lane] = kept1
        m[RAW_SHARE + 2 * BLOCK + lane] = kept2
        odds = exp_wide(-m[LOGIT + lane])
        sigmoid = 1.0 / (1.0 + odds)
        m[OPACITY + lane] = math.sqrt(kept0 * kept1 * kept2) * sigmoid
        m[TRANSPARENCY + lane] = odds * sigmoid
    for lane in range(BLOCK):
        # tanh(s) = (e - 1) / (e + 1) with e = exp(2 s), accurate for the smallest s too.
        sign = m[ORIENTATION + 3 * BLOCK + lane]
        sign = -_SIGN_END if sign < -_SIGN_END else sign
        sign = _SIGN_END if sign > _SIGN_END else sign
        scale, p = exp_parts(2.0 * sign)
        less_one = (scale - 1.0) + scale * p
        share = 1.0 / (less_one + 2.0)
        m[TANH + lane] = less_one * share
        m[SLOPE + lane] = 4.0 * (less_one + 1.0) * share * share
        d0, d1 = m[ORIENTATION + lane], m[ORIENTATION + BLOCK + lane]
        d2 = m[ORIENTATION + 2 * BLOCK + lane]
        length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        short = length <= _DIRECTION_MIN_NORM
        length = _DIRECTION_MIN_NORM if short else length
        inverse = 1.0 / length
        m[ORIENTATION + lane] = d0 * inverse
        m[ORIENTATION + BLOCK + lane] = d1 * inverse
        m[ORIENTATION + 2 * BLOCK + lane] = d2 * inverse
        m[ORIENTATION + 3 * BLOCK + lane] = 0.0 if short else inverse
    for lane in range(BLOCK):
        d0 = m[MEAN + lane] - o0
        d1 = m[MEAN + BLOCK + lane] - o1
        d2 = m[MEAN + 2 * BLOCK + lane] - o2
        inverse = 1.0 / math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        d0, d1, d2 = d0 * inverse, d1 * inverse, d2 * inverse
        m[RAY + lane] = d0
        m[RAY + BLOCK + lane] = d1
        m[RAY + 2 * BLOCK + lane] = d2
        m[RAY + 3 * BLOCK + lane] = inverse
        write_basis(m, BASIS, lane, d0, d1, d2)
