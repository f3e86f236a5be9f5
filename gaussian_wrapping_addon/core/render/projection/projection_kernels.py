# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled forward projection of Gaussians of any depth-to-size ratio, in float64.

Notation of docs/method.md, section 2.3, with ``w0 = (u, v, 1)`` the ray through the mean (camera
frame), ``axis_k`` the Gaussian's axes and ``e_k = axis_k . w0``. The inverse covariance of the
exact projection is written as a sum of squares,

    Q = z^2 / a0 * sum_k (s_i s_j)^-2 g_k g_k^T,   (i, j) the other two axes,

so neither a grazing disc nor an anisotropy of 1e6 suffers from cancellation. The screen box is that
of the ellipse ``alpha >= 1/255``, from the dual conic of the ellipsoid: it is bounded exactly while
the whole ellipsoid lies in front of the camera plane.

A cheap first pass culls Gaussians behind the camera, too faint, or certainly outside the image; the
others are projected in blocks (``projection_math.py``).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ... import tolerances
from ...kernels.compiled import inline, kernel, part
from .projection_activation import (
    ACTIVATED_PLANES,
    BASIS,
    MEAN,
    OPACITY,
    ORIENTATION,
    ROTATION,
    SCALE,
    TANH,
    activate_block,
    load_raw,
)
from .projection_math import BLOCK, QUEUE, block_scratch, log_wide

PARAM_COLUMNS = 24
CAMERA_VALUES = 22
"""Packed camera: rotation 0-8, translation 9-11, centre 12-14, fx fy cx cy 15-18, width height
19-20, near z 21."""

_ALPHA_MIN = tolerances.ALPHA_MIN
_TILE = float(tolerances.TILE_PX)
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
        c[0] * a + c[1] * b + c[2] * d,
        c[3] * a + c[4] * b + c[5] * d,
        c[6] * a + c[7] * b + c[8] * d,
    )


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
            c,
            m[ROTATION + BLOCK + lane],
            m[ROTATION + 4 * BLOCK + lane],
            m[ROTATION + 7 * BLOCK + lane],
        )
        r02, r12, r22 = in_camera(
            c,
            m[ROTATION + 2 * BLOCK + lane],
            m[ROTATION + 5 * BLOCK + lane],
            m[ROTATION + 8 * BLOCK + lane],
        )
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
        finite = (reach_x <= tolerances.FINITE_OFFSET_PX) & (reach_y <= tolerances.FINITE_OFFSET_PX)
        finite &= (num <= tolerances.FINITE_NUM) & (den <= tolerances.FINITE_DEN)
        finite &= a0 * sigma_z * sigma_z <= tolerances.FINITE_SPREAD
        finite &= a0 * den * z <= tolerances.FINITE_PULL
        finite &= (z >= tolerances.FINITE_Z_MIN) & (z <= tolerances.FINITE_Z_MAX)
        finite &= (sigma_z <= tolerances.FINITE_SIGMA_Z) & (total < _FLOAT32_MAX)
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
    begin: int,
    end: int,
    means: np.ndarray,
    log_scales: np.ndarray,
    quats: np.ndarray,
    opacity_logits: np.ndarray,
    sh: np.ndarray,
    orientation: np.ndarray,
    filter_3d: np.ndarray,
    degree: int,
    camera: np.ndarray,
    params: np.ndarray,
    boxes: np.ndarray,
    visible: np.ndarray,
    depths: np.ndarray,
    skews: np.ndarray,
) -> None:
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
                brightest = tolerances.FINITE_COLOR  # NaN fails the test; max() would drop it
                if not (red <= brightest and green <= brightest and blue <= brightest):
                    continue
                m[_PARAM + 13 * BLOCK + lane] = max(red, 0.0)
                m[_PARAM + 14 * BLOCK + lane] = max(green, 0.0)
                m[_PARAM + 15 * BLOCK + lane] = max(blue, 0.0)
                _write_row(m, lane, i, params, boxes, visible, depths, skews)


@kernel(fast=False, fused=True)
def project_activated_range(
    begin: int,
    end: int,
    means: np.ndarray,
    scales: np.ndarray,
    rotations: np.ndarray,
    log_opacities: np.ndarray,
    normals: np.ndarray,
    camera: np.ndarray,
    params: np.ndarray,
    boxes: np.ndarray,
    visible: np.ndarray,
    depths: np.ndarray,
    skews: np.ndarray,
) -> None:
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
