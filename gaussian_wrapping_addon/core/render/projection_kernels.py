# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians to screen Gaussians: kernels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from .. import limits
from ..compiled import inline, kernel, part

# -- Blocks of float64 for the projection kernels, with vectorisable exponential and logarithm ----
#
# Gaussians are projected in blocks of 8. Every value of a block is a *plane* of 8 float64 inside
# one scratch array; loops over a block have a constant trip count, constant offsets in that one
# array and no branches, which is what lets LLVM vectorise them. A partial block is padded with
# copies of its last Gaussian, so that no value depends on its neighbours.
#
# No vector math library is available, and one scalar call would prevent vectorisation, so the
# exponential and the logarithm are polynomials (minimax in relative error, found with 50 digits).


BLOCK = 8
QUEUE = 256
"""Number of Gaussians left after culling that are collected before they are projected."""
_LINE_VALUES = 8  # float64 in a cache line

# exp(x) underflows to 0 below and overflows to infinity above; in between 2^n is a normal number.
_EXP_LOW, _EXP_HIGH = -708.0, 709.0
_LOG2_E = 1.0 / math.log(2.0)
# ln 2 in two parts; the first has 20 zero bits at its end, so that its multiples are exact.
_LN2_HIGH, _LN2_LOW = 0.6931471804855391, 7.440617110012397e-11
# Adding this rounds to an integer, which is then in the lowest bits.
_ROUNDER = 1.5 * 2.0**52
# (exp(r) - 1 - r) / r^2 for |r| <= ln(2) / 2; error of exp(r) - 1 is 5e-17 relative.
_E2, _E3, _E4, _E5 = 1 / 2, 1 / 6, 0.04166666666662412, 0.008333333333322207
_E6, _E7, _E8 = 0.0013888888917217457, 0.00019841269886591, 2.4801521290973345e-05
_E9, _E10, _E11 = 2.7557242336680357e-06, 2.7620090518499427e-07, 2.5110049895858716e-08
# (2 atanh(s) / s - 2) / s^2 by powers of s^2, for |s| <= tan(pi / 8)^2; error 5e-18.
_L0, _L1, _L2 = 0.666666666666667, 0.3999999999989789, 0.2857142862665141
_L3, _L4, _L5 = 0.22222211031749325, 0.18182896207631685, 0.15331497764506818
_L6 = 0.1461909699201228
_MANTISSA = (1 << 52) - 1
_EXPONENT_OF_ONE = 1023
_ONE_BITS = _EXPONENT_OF_ONE << 52
_ROUNDER_BITS = int(np.array(_ROUNDER).view(np.int64))
_ROUNDED_BIAS = _ROUNDER + _EXPONENT_OF_ONE
_SQRT_HALF_BITS = int(np.array(math.sqrt(0.5)).view(np.int64))


@intrinsic
def _bits_of(typingctx, value):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], ir.IntType(64))

    return types.int64(types.float64), generate


@intrinsic
def _float_of(typingctx, bits):  # type: ignore[no-untyped-def]
    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], ir.DoubleType())

    return types.float64(types.int64), generate


@inline
def exp_parts(x: Any) -> Any:
    """Return ``(s, p)`` with ``exp(x) = s + s p``, ``s`` a power of two and ``|p| < 0.42``.

    Right to 1e-15 relative where ``-708 <= x <= 709``; x is taken to these ends beyond them. NaN
    stays NaN. ``(s - 1) + s p`` is ``exp(x) - 1`` without cancellation.
    """
    y = _EXP_LOW if x < _EXP_LOW else x
    y = _EXP_HIGH if y > _EXP_HIGH else y
    shifted = y * _LOG2_E + _ROUNDER
    n = shifted - _ROUNDER
    r = (y - n * _LN2_HIGH) - n * _LN2_LOW
    p = (((_E11 * r + _E10) * r + _E9) * r + _E8) * r + _E7
    p = ((((p * r + _E6) * r + _E5) * r + _E4) * r + _E3) * r + _E2
    p = p * (r * r) + r
    scale: Any = _float_of((_bits_of(shifted) + _EXPONENT_OF_ONE) << 52)  # type: ignore[call-arg]
    return scale, p


@inline
def exp_wide(x: Any) -> Any:
    """Return exp(x) to 1e-15 relative, 0 below -708 and infinity above 709; NaN stays NaN."""
    scale, p = exp_parts(x)
    value = scale + scale * p
    value = 0.0 if x < _EXP_LOW else value
    return math.inf if x > _EXP_HIGH else value


@inline
def log_wide(x: Any) -> Any:
    """Return ln(x) for a positive normal x, to 4e-16 of the larger of 1 and the result."""
    # Mantissa in [sqrt(1/2), sqrt(2)); the exponent is converted via the lowest bits of a float.
    shifted: Any = _bits_of(x) - _SQRT_HALF_BITS  # type: ignore[call-arg]
    mantissa: Any = _float_of((shifted & _MANTISSA) + _SQRT_HALF_BITS)
    biased = (shifted + _ONE_BITS) >> 52
    whole: Any = _float_of(biased + _ROUNDER_BITS) - _ROUNDED_BIAS
    s = (mantissa - 1.0) / (mantissa + 1.0)
    z = s * s
    g = (((((_L6 * z + _L5) * z + _L4) * z + _L3) * z + _L2) * z + _L1) * z + _L0
    return whole * _LN2_HIGH + (whole * _LN2_LOW + (s * z * g + 2.0 * s))


@inline
def block_scratch(planes: Any) -> Any:
    """Return uninitialised planes of one block, aligned to a cache line."""
    values = np.empty(planes * BLOCK + _LINE_VALUES, np.float64)
    offset = -(values.ctypes.data >> 3) & (_LINE_VALUES - 1)
    return values[offset : offset + planes * BLOCK]


# -- Real spherical harmonics up to degree 3 and their gradient, over blocks of directions --------
#
# Order and signs are those of 3D Gaussian splatting files (Condon-Shortley phase): the bands are
# ``1``, ``-y z -x``, then degree 2 and 3 with ``m`` from ``-l`` to ``l``. All degrees are always
# evaluated: a few dozen packed operations, cheaper than branching.


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


# -- Compiled activation of blocks of raw Gaussians, the first step of projection and its gradient
#
# Also the layout of the scratch planes that both use (``projection_kernels.py``).


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

_QUATERNION_MIN_SQ = limits.QUATERNION_MIN_NORM**2
_DIRECTION_MIN_NORM = limits.DIRECTION_MIN_NORM
# Beyond, tanh is 1 in float64.
_SIGN_END = 20.0


@inline
def load_raw(
    m: Any, lane: Any, i: Any, means: Any, log_scales: Any, quats: Any, opacity_logits: Any,
    orientation: Any, filter_3d: Any,
) -> None:  # fmt: skip
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
            m[RAW_SHARE + lane], m[RAW_SHARE + BLOCK + lane], m[RAW_SHARE + 2 * BLOCK + lane],
        )  # fmt: skip
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


# -- Compiled forward projection of Gaussians of any depth-to-size ratio, in float64 --------------
#
# Notation of docs/method.md, section 2.3, with ``w0 = (u, v, 1)`` the ray through the mean
# (camera frame), ``axis_k`` the Gaussian's axes and ``e_k = axis_k . w0``. The inverse covariance
# of the exact projection is written as a sum of squares,
#
#     Q = z^2 / a0 * sum_k (s_i s_j)^-2 g_k g_k^T,   (i, j) the other two axes,
#
# so neither a grazing disc nor an anisotropy of 1e6 suffers from cancellation. The screen box is
# that of the ellipse ``alpha >= 1/255``, from the dual conic of the ellipsoid: it is bounded
# exactly while the whole ellipsoid lies in front of the camera plane.
#
# A cheap first pass culls Gaussians behind the camera, too faint, or certainly outside the image;
# the others are projected in blocks (``projection_kernels.py``).


PARAM_COLUMNS = 24
CAMERA_VALUES = 22
"""Packed camera: rotation 0-8, translation 9-11, centre 12-14, fx fy cx cy 15-18, width height
19-20, near z 21."""

_ALPHA_MIN = limits.ALPHA_MIN
_TILE = float(limits.TILE_PX)
# An ellipsoid that touches the camera plane within rounding error is treated as crossing it.
_PLANE_MARGIN = 1e-12
_FLOAT32_MAX = 3.0e38
_FLOAT32_STEP = 2.0**-23
# Boxes are clipped here so that pixel ranges always fit an int32.
_FARTHEST_PX = 1.0e9
# Whatever its scales, a Gaussian with a smaller logit is fainter than 1/255; 1e-3 below the limit.
_MIN_LOGIT = -math.log(1.0 / _ALPHA_MIN - 1.0) - 1e-3
# Largest half axis of the ellipsoid at 1/255 in standard deviations; with a margin for rounding.
_REACH = math.sqrt(-2.0 * math.log(_ALPHA_MIN)) * (1.0 + 1e-6)

# Planes of the scratch array after those of the activation: columns of params, boxes, others.
_PARAM = ACTIVATED_PLANES * BLOCK
_BOX = _PARAM + PARAM_COLUMNS * BLOCK
_DEPTH = _BOX + 4 * BLOCK
_SKEW = _DEPTH + BLOCK
_VISIBLE = _SKEW + BLOCK
_PLANES = _VISIBLE // BLOCK + 1


@inline
def load_camera_axes(camera: Any) -> Any:
    """Return the nine values of the packed camera's rotation, row by row."""
    return (
        camera[0], camera[1], camera[2], camera[3], camera[4], camera[5],
        camera[6], camera[7], camera[8],
    )  # fmt: skip


@inline
def in_camera(c: Any, a: Any, b: Any, d: Any) -> Any:
    """Return the vector (a, b, d) rotated by ``c``."""
    return (
        c[0] * a + c[1] * b + c[2] * d, c[3] * a + c[4] * b + c[5] * d,
        c[6] * a + c[7] * b + c[8] * d,
    )  # fmt: skip


@inline
def _outward(value: Any, side: Any) -> Any:
    """Move a box edge one float32 step outwards (``side`` -1 or 1) and round it."""
    value = -_FARTHEST_PX if value < -_FARTHEST_PX else value
    value = _FARTHEST_PX if value > _FARTHEST_PX else value
    return np.float64(np.float32(value + side * _FLOAT32_STEP * abs(value)))


@part(fast=False, fused=True)
def _project_shapes(m: Any, camera: Any) -> None:
    """Compute all of a block except colours, and which Gaussians are visible."""
    c = load_camera_axes(camera)
    t0, t1, t2 = camera[9], camera[10], camera[11]
    fx, fy, cx, cy = camera[15], camera[16], camera[17], camera[18]
    width, height, near_z = camera[19], camera[20], camera[21]
    near_z = max(near_z, 0.0)
    ifx, ify = 1.0 / fx, 1.0 / fy
    ixx, ixy, iyy = ifx * ifx, 2.0 * ifx * ify, ify * ify
    for lane in range(BLOCK):
        x, y, z = in_camera(c, m[MEAN + lane], m[MEAN + BLOCK + lane], m[MEAN + 2 * BLOCK + lane])
        x, y, z = x + t0, y + t1, z + t2
        inverse_z = 1.0 / z
        u, v = x * inverse_z, y * inverse_z
        r00, r10, r20 = in_camera(
            c, m[ROTATION + lane], m[ROTATION + 3 * BLOCK + lane], m[ROTATION + 6 * BLOCK + lane]
        )
        r01, r11, r21 = in_camera(
            c, m[ROTATION + BLOCK + lane], m[ROTATION + 4 * BLOCK + lane],
            m[ROTATION + 7 * BLOCK + lane],
        )  # fmt: skip
        r02, r12, r22 = in_camera(
            c, m[ROTATION + 2 * BLOCK + lane], m[ROTATION + 5 * BLOCK + lane],
            m[ROTATION + 8 * BLOCK + lane],
        )  # fmt: skip
        var0, var1, var2 = m[SCALE + lane], m[SCALE + BLOCK + lane], m[SCALE + 2 * BLOCK + lane]
        w0, w1, w2 = 1.0 / var0, 1.0 / var1, 1.0 / var2
        others0, others1, others2 = w1 * w2, w2 * w0, w0 * w1
        e0 = r00 * u + r10 * v + r20
        e1 = r01 * u + r11 * v + r21
        e2 = r02 * u + r12 * v + r22
        ew0, ew1, ew2 = e0 * w0, e1 * w1, e2 * w2
        a0 = e0 * ew0 + e1 * ew1 + e2 * ew2
        hx = r00 * ew0 + r01 * ew1 + r02 * ew2
        hy = r10 * ew0 + r11 * ew1 + r12 * ew2
        hz = r20 * ew0 + r21 * ew1 + r22 * ew2
        inverse_a0 = 1.0 / a0
        k_xx, k_xy, k_yy = inverse_a0 * ixx, inverse_a0 * ixy, inverse_a0 * iyy
        m[_PARAM + lane] = fx * u + cx
        m[_PARAM + BLOCK + lane] = fy * v + cy
        m[_PARAM + 5 * BLOCK + lane] = hx * inverse_a0 * ifx
        m[_PARAM + 6 * BLOCK + lane] = hy * inverse_a0 * ify
        p00, p01, p02 = r00 * w0, r01 * w1, r02 * w2
        m[_PARAM + 7 * BLOCK + lane] = (r00 * p00 + r01 * p01 + r02 * p02) * k_xx
        m[_PARAM + 8 * BLOCK + lane] = (r10 * p00 + r11 * p01 + r12 * p02) * k_xy
        m[_PARAM + 9 * BLOCK + lane] = (r10 * r10 * w0 + r11 * r11 * w1 + r12 * r12 * w2) * k_yy
        m[_PARAM + 10 * BLOCK + lane] = z
        opacity = m[OPACITY + lane]
        m[_PARAM + 11 * BLOCK + lane] = opacity
        m[_PARAM + 12 * BLOCK + lane] = a0
        flip = -1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
        nx, ny, nz = hx * flip, hy * flip, hz * flip
        m[_PARAM + 19 * BLOCK + lane] = c[0] * nx + c[3] * ny + c[6] * nz
        m[_PARAM + 20 * BLOCK + lane] = c[1] * nx + c[4] * ny + c[7] * nz
        m[_PARAM + 21 * BLOCK + lane] = c[2] * nx + c[5] * ny + c[8] * nz

        f00, f01, f02 = r00 - u * r20, r01 - u * r21, r02 - u * r22
        f10, f11, f12 = r10 - v * r20, r11 - v * r21, r12 - v * r22
        zz = z * z
        o0, o1, o2 = f00 * others0, f01 * others1, f02 * others2
        m[_PARAM + 4 * BLOCK + lane] = zz * k_yy * (f00 * o0 + f01 * o1 + f02 * o2)
        m[_PARAM + 3 * BLOCK + lane] = -zz * k_xy * (f10 * o0 + f11 * o1 + f12 * o2)
        m[_PARAM + 2 * BLOCK + lane] = (
            zz * k_xx * (f10 * f10 * others0 + f11 * f11 * others1 + f12 * f12 * others2)
        )
        s0, s1, s2 = f00 * var0, f01 * var1, f02 * var2
        cov_xx = f00 * s0 + f01 * s1 + f02 * s2
        cov_xy = f10 * s0 + f11 * s1 + f12 * s2
        cov_xz = r20 * s0 + r21 * s1 + r22 * s2
        s0, s1, s2 = f10 * var0, f11 * var1, f12 * var2
        cov_yy = f10 * s0 + f11 * s1 + f12 * s2
        cov_yz = r20 * s0 + r21 * s1 + r22 * s2
        cov_zz = r20 * r20 * var0 + r21 * r21 * var1 + r22 * r22 * var2
        m[_PARAM + 22 * BLOCK + lane] = math.sqrt(cov_zz)
        m[_DEPTH + lane] = math.sqrt(x * x + y * y + zz)

        threshold = 2.0 * log_wide(opacity * (1.0 / _ALPHA_MIN))
        scale = zz - threshold * cov_zz
        bounded = scale > _PLANE_MARGIN * zz
        # The silhouette's dual conic, relative to (u, v): centre and half axes of the ellipse.
        share = threshold / scale
        middle_x = fx * (u - share * cov_xz) + cx
        middle_y = fy * (v - share * cov_yz) + cy
        spread_xx = share * (cov_xx + share * cov_xz * cov_xz)
        spread_xy = share * (cov_xy + share * cov_xz * cov_yz)
        root_y = math.sqrt(share * (cov_yy + share * cov_yz * cov_yz))
        half_x, half_y = fx * math.sqrt(spread_xx), fy * root_y
        left, right = _outward(middle_x - half_x, -1.0), _outward(middle_x + half_x, 1.0)
        top, bottom = _outward(middle_y - half_y, -1.0), _outward(middle_y + half_y, 1.0)
        skew = fx * spread_xy / root_y
        left = left if bounded else 0.0
        top = top if bounded else 0.0
        right = right if bounded else width
        bottom = bottom if bounded else height
        m[_BOX + lane] = left
        m[_BOX + BLOCK + lane] = top
        m[_BOX + 2 * BLOCK + lane] = right
        m[_BOX + 3 * BLOCK + lane] = bottom
        m[_SKEW + lane] = skew if bounded else math.inf

        # Visible if the box contains a pixel centre of the image.
        first_x, last_x = np.ceil(left - 0.5), np.floor(right - 0.5)
        first_y, last_y = np.ceil(top - 0.5), np.floor(bottom - 0.5)
        first_x = 0.0 if first_x < 0.0 else first_x
        first_y = 0.0 if first_y < 0.0 else first_y
        last_x = width - 1.0 if last_x > width - 1.0 else last_x
        last_y = height - 1.0 if last_y > height - 1.0 else last_y
        seen = (first_x <= last_x) & (first_y <= last_y)
        seen = seen & (z > near_z) & (opacity > _ALPHA_MIN)
        m[_VISIBLE + lane] = 1.0 if seen else 0.0
    for lane in range(BLOCK):
        tanh = m[TANH + lane]
        m[_PARAM + 16 * BLOCK + lane] = tanh * m[ORIENTATION + lane]
        m[_PARAM + 17 * BLOCK + lane] = tanh * m[ORIENTATION + BLOCK + lane]
        m[_PARAM + 18 * BLOCK + lane] = tanh * m[ORIENTATION + 2 * BLOCK + lane]
        # Not visible if rendering would overflow float32 (docs/architecture.md).
        u, v, z = m[_PARAM + lane], m[_PARAM + BLOCK + lane], m[_PARAM + 10 * BLOCK + lane]
        reach_x = max(abs(u), abs(width - u)) + _TILE
        reach_y = max(abs(v), abs(height - v)) + _TILE
        xx, xy, yy = reach_x * reach_x, reach_x * reach_y, reach_y * reach_y
        num = m[_PARAM + 2 * BLOCK + lane] * xx + m[_PARAM + 4 * BLOCK + lane] * yy
        num += abs(m[_PARAM + 3 * BLOCK + lane]) * xy
        den = m[_PARAM + 7 * BLOCK + lane] * xx + m[_PARAM + 9 * BLOCK + lane] * yy
        den += abs(m[_PARAM + 8 * BLOCK + lane]) * xy + 1.0
        den += 2.0 * abs(m[_PARAM + 5 * BLOCK + lane]) * reach_x
        den += 2.0 * abs(m[_PARAM + 6 * BLOCK + lane]) * reach_y
        a0, sigma_z = m[_PARAM + 12 * BLOCK + lane], m[_PARAM + 22 * BLOCK + lane]
        # NaN and infinity propagate through a sum of absolute values.
        total = m[_DEPTH + lane] + abs(m[_BOX + lane]) + abs(m[_BOX + BLOCK + lane])
        total += abs(m[_BOX + 2 * BLOCK + lane]) + abs(m[_BOX + 3 * BLOCK + lane])
        total += abs(m[_PARAM + 16 * BLOCK + lane]) + abs(m[_PARAM + 17 * BLOCK + lane])
        total += abs(m[_PARAM + 18 * BLOCK + lane]) + abs(m[_PARAM + 19 * BLOCK + lane])
        total += abs(m[_PARAM + 20 * BLOCK + lane]) + abs(m[_PARAM + 21 * BLOCK + lane])
        skew = m[_SKEW + lane]
        total += 0.0 if skew == math.inf else abs(skew)
        finite = (reach_x <= limits.FINITE_OFFSET_PX) & (reach_y <= limits.FINITE_OFFSET_PX)
        finite &= (num <= limits.FINITE_NUM) & (den <= limits.FINITE_DEN)
        finite &= a0 * sigma_z * sigma_z <= limits.FINITE_SPREAD
        finite &= a0 * den * z <= limits.FINITE_PULL
        finite &= (z >= limits.FINITE_Z_MIN) & (z <= limits.FINITE_Z_MAX)
        finite &= (sigma_z <= limits.FINITE_SIGMA_Z) & (total < _FLOAT32_MAX)
        m[_VISIBLE + lane] = m[_VISIBLE + lane] if finite else 0.0


@inline
def _write_row(
    m: Any, lane: Any, i: Any, params: Any, boxes: Any, visible: Any, depths: Any, skews: Any
) -> None:
    """Copy one Gaussian of a block to the screen arrays."""
    for column in range(PARAM_COLUMNS - 1):
        params[i, column] = m[_PARAM + column * BLOCK + lane]
    params[i, 23] = 0.0
    for column in range(4):
        boxes[i, column] = m[_BOX + column * BLOCK + lane]
    depths[i] = m[_DEPTH + lane]
    skews[i] = m[_SKEW + lane]
    visible[i] = True


@kernel(fast=False, fused=True)
def project_raw_range(
    begin: int, end: int, means: np.ndarray, log_scales: np.ndarray, quats: np.ndarray,
    opacity_logits: np.ndarray, sh: np.ndarray, orientation: np.ndarray, filter_3d: np.ndarray,
    degree: int, camera: np.ndarray, params: np.ndarray, boxes: np.ndarray, visible: np.ndarray,
    depths: np.ndarray, skews: np.ndarray,
) -> None:  # fmt: skip
    """Project the raw Gaussians ``begin .. end``; hidden ones only get visibility and depth."""
    m = block_scratch(_PLANES)
    queue = np.empty(QUEUE + BLOCK, np.int64)
    coefficients = (degree + 1) * (degree + 1)
    fx, fy, cx, cy = camera[15], camera[16], camera[17], camera[18]
    width, height = camera[19], camera[20]
    # Unit normals of the planes through the image's sides, pointing outwards.
    left = 1.0 / math.sqrt(fx * fx + cx * cx)
    right = 1.0 / math.sqrt(fx * fx + (width - cx) * (width - cx))
    top = 1.0 / math.sqrt(fy * fy + cy * cy)
    bottom = 1.0 / math.sqrt(fy * fy + (height - cy) * (height - cy))
    at = begin
    while at < end:
        count = 0
        while at < end and count < QUEUE:
            i = at
            at += 1
            visible[i] = False
            depths[i] = np.inf
            m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            z = camera[6] * m0 + camera[7] * m1 + camera[8] * m2 + camera[11]
            if not z > camera[21] or opacity_logits[i] < _MIN_LOGIT:
                continue
            x = camera[0] * m0 + camera[1] * m1 + camera[2] * m2 + camera[9]
            y = camera[3] * m0 + camera[4] * m1 + camera[5] * m2 + camera[10]
            outside = max(
                max((-fx * x - cx * z) * left, (fx * x - (width - cx) * z) * right),
                max((-fy * y - cy * z) * top, (fy * y - (height - cy) * z) * bottom),
            )
            if outside > 0.0:
                # Entirely outside one side plane, and entirely in front of the camera plane.
                largest = max(np.float64(log_scales[i, 0]), np.float64(log_scales[i, 1]))
                largest = max(largest, np.float64(log_scales[i, 2]))
                blur = np.float64(filter_3d[i])
                radius = _REACH * math.sqrt(math.exp(2.0 * largest) + blur * blur)
                if outside > radius and z > radius:
                    continue
            queue[count] = i
            count += 1
        for pad in range(count, (count + BLOCK - 1) // BLOCK * BLOCK):
            queue[pad] = queue[count - 1]
        for first in range(0, count, BLOCK):
            for lane in range(BLOCK):
                i = queue[first + lane]
                load_raw(
                    m, lane, i, means, log_scales, quats, opacity_logits, orientation, filter_3d
                )
            activate_block(m, camera)
            _project_shapes(m, camera)
            for lane in range(min(BLOCK, count - first)):
                if m[_VISIBLE + lane] == 0.0:
                    continue
                i = queue[first + lane]
                red = green = blue = 0.5
                for k in range(coefficients):
                    value = m[BASIS + k * BLOCK + lane]
                    red += value * np.float64(sh[i, k, 0])
                    green += value * np.float64(sh[i, k, 1])
                    blue += value * np.float64(sh[i, k, 2])
                brightest = limits.FINITE_COLOR  # NaN fails the test; max() would drop it
                if not (red <= brightest and green <= brightest and blue <= brightest):
                    continue
                m[_PARAM + 13 * BLOCK + lane] = max(red, 0.0)
                m[_PARAM + 14 * BLOCK + lane] = max(green, 0.0)
                m[_PARAM + 15 * BLOCK + lane] = max(blue, 0.0)
                _write_row(m, lane, i, params, boxes, visible, depths, skews)


@kernel(fast=False, fused=True)
def project_activated_range(
    begin: int, end: int, means: np.ndarray, scales: np.ndarray, rotations: np.ndarray,
    log_opacities: np.ndarray, normals: np.ndarray, camera: np.ndarray, params: np.ndarray,
    boxes: np.ndarray, visible: np.ndarray, depths: np.ndarray, skews: np.ndarray,
) -> None:  # fmt: skip
    """Project the activated Gaussians ``begin .. end``; the colour columns are 0."""
    m = block_scratch(_PLANES)
    for lane in range(BLOCK):
        m[_PARAM + 13 * BLOCK + lane] = 0.0
        m[_PARAM + 14 * BLOCK + lane] = 0.0
        m[_PARAM + 15 * BLOCK + lane] = 0.0
    for first in range(begin, end, BLOCK):
        for lane in range(BLOCK):
            i = min(first + lane, end - 1)
            for axis in range(3):
                m[MEAN + axis * BLOCK + lane] = means[i, axis]
                m[SCALE + axis * BLOCK + lane] = scales[i, axis] * scales[i, axis]
                m[ORIENTATION + axis * BLOCK + lane] = normals[i, axis]
                for column in range(3):
                    m[ROTATION + (3 * axis + column) * BLOCK + lane] = rotations[i, axis, column]
            m[TANH + lane] = 1.0
            m[OPACITY + lane] = math.exp(log_opacities[i])
        _project_shapes(m, camera)
        for lane in range(min(BLOCK, end - first)):
            i = first + lane
            visible[i] = False
            depths[i] = np.inf
            if m[_VISIBLE + lane] != 0.0:
                _write_row(m, lane, i, params, boxes, visible, depths, skews)
