# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians to screen Gaussians, and the gradient back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from .. import limits
from ..compiled import inline, kernel, part
from ..errors import UsageError
from ..gaussians.model import TRAINED, GaussianArrays, OrientedGaussians
from ..parallel import default_threads, even_bounds, run_chunks
from ..scene.camera import Camera
from .projection_kernels import (
    ACTIVATED_PLANES,
    BASIS,
    BASIS_COUNT,
    BLOCK,
    CAMERA_VALUES,
    MAX_DEGREE,
    MEAN,
    OPACITY,
    ORIENTATION,
    PARAM_COLUMNS,
    QUAT,
    QUEUE,
    RAW_SHARE,
    RAY,
    ROTATION,
    SCALE,
    SLOPE,
    TANH,
    TRANSPARENCY,
    activate_block,
    block_scratch,
    direction_gradient,
    in_camera,
    load_camera_axes,
    load_raw,
    project_activated_range,
    project_raw_range,
)
from .types import RenderOptions, VisibleGradients

# -- Compiled analytic gradient of the projection, the reverse of ``projection_kernels.py`` -------
#
# With ``weight_k = 1 / scale_k^2`` all outputs of the forward pass are functions of
#
#     e_k = axis_k . w0,           h = sum_k axis_k e_k weight_k,     a0 = sum_k e_k^2 weight_k,
#     B = sum_k (r0, r1)_k (r0, r1)_k^T weight_k,
#     F = sum_k f_k f_k^T weight_i weight_j,   f_k = (r0 - u r2, r1 - v r2)_k,   (i, j) != k;
#
# the gradient is accumulated on a0, h, B, F and (u, v, z) first, then on axes and log weights.
# Like the forward pass it works on blocks of Gaussians (``projection_kernels.py``).


_QUATERNION_MIN_SQ = limits.QUATERNION_MIN_NORM**2
_USED_COLUMNS = 23

# Planes of the scratch array after those of the activation: gradients on the columns of params, on
# the basis functions, and on trained parameters. That on the rotation overwrites the rotation.
_GRAD = ACTIVATED_PLANES * BLOCK
_WEIGHT = _GRAD + _USED_COLUMNS * BLOCK
_GRAD_MEAN = _WEIGHT + BASIS_COUNT * BLOCK
_GRAD_SCALE = _GRAD_MEAN + 3 * BLOCK
_GRAD_QUAT = _GRAD_SCALE + 3 * BLOCK
_GRAD_ORIENTATION = _GRAD_QUAT + 4 * BLOCK
_GRAD_LOGIT = _GRAD_ORIENTATION + 4 * BLOCK
_PLANES = _GRAD_LOGIT // BLOCK + 1
_WRITTEN_PLANES = _PLANES - _GRAD_MEAN // BLOCK

_GRADIENT_MAX = 1e38
"""Larger gradients are dropped: a third of the largest float32, so that squared norms fit float64
and sums of a few views fit float32."""
_BASIS_MAX = 3.0  # no basis function is larger on the sphere


@inline
def _axis_gradient(
    r: Any, e: Any, f0: Any, f1: Any, weight: Any, others: Any, spread: Any,
    g_a0: Any, g_h: Any, g_b: Any, g_f: Any,
) -> Any:  # fmt: skip
    """Return one axis' gradients: on e, f0, f1, directly on its r0 r1 r2, on two log weights.

    ``g_h`` (3), ``g_b`` and ``g_f`` (xx, xy, yy) are on h, B and F; ``spread`` is the gradient on
    ``cov_zz`` times the axis' variance.
    """
    h_dot = g_h[0] * r[0] + g_h[1] * r[1] + g_h[2] * r[2]
    scaled = weight * e
    g_e = weight * h_dot + 2.0 * scaled * g_a0
    b0, b1 = 2.0 * r[0] * g_b[0] + r[1] * g_b[1], r[0] * g_b[1] + 2.0 * r[1] * g_b[2]
    k0, k1 = 2.0 * f0 * g_f[0] + f1 * g_f[1], f0 * g_f[1] + 2.0 * f1 * g_f[2]
    along = r[2] * spread
    # B and F are quadratic: their part of the sum is half of value times slope.
    log_self = 2.0 * (r[2] * along - scaled * (h_dot + e * g_a0)) - weight * (r[0] * b0 + r[1] * b1)
    log_others = -others * (f0 * k0 + f1 * k1)
    return (
        g_e, others * k0, others * k1,
        scaled * g_h[0] + weight * b0, scaled * g_h[1] + weight * b1,
        scaled * g_h[2] + 2.0 * along,
        log_self, log_others,
    )  # fmt: skip


@part(fast=False, fused=True)
def _shape_gradients(m: Any, camera: Any) -> None:
    """Propagate gradients from columns 0-12 and 19-22 to mean, log scales and rotation."""
    c = load_camera_axes(camera)
    t0, t1, t2 = camera[9], camera[10], camera[11]
    fx, fy = camera[15], camera[16]
    ifx, ify = 1.0 / fx, 1.0 / fy
    for lane in range(BLOCK):
        x, y, z = in_camera(c, m[MEAN + lane], m[MEAN + BLOCK + lane], m[MEAN + 2 * BLOCK + lane])
        x, y, z = x + t0, y + t1, z + t2
        inverse_z = 1.0 / z
        u, v = x * inverse_z, y * inverse_z
        a = in_camera(
            c, m[ROTATION + lane], m[ROTATION + 3 * BLOCK + lane], m[ROTATION + 6 * BLOCK + lane]
        )
        b = in_camera(
            c, m[ROTATION + BLOCK + lane], m[ROTATION + 4 * BLOCK + lane],
            m[ROTATION + 7 * BLOCK + lane],
        )  # fmt: skip
        d = in_camera(
            c, m[ROTATION + 2 * BLOCK + lane], m[ROTATION + 5 * BLOCK + lane],
            m[ROTATION + 8 * BLOCK + lane],
        )  # fmt: skip
        var0, var1, var2 = m[SCALE + lane], m[SCALE + BLOCK + lane], m[SCALE + 2 * BLOCK + lane]
        w0, w1, w2 = 1.0 / var0, 1.0 / var1, 1.0 / var2
        others0, others1, others2 = w1 * w2, w2 * w0, w0 * w1
        e0 = a[0] * u + a[1] * v + a[2]
        e1 = b[0] * u + b[1] * v + b[2]
        e2 = d[0] * u + d[1] * v + d[2]
        ew0, ew1, ew2 = e0 * w0, e1 * w1, e2 * w2
        a0 = e0 * ew0 + e1 * ew1 + e2 * ew2
        hx = a[0] * ew0 + b[0] * ew1 + d[0] * ew2
        hy = a[1] * ew0 + b[1] * ew1 + d[1] * ew2
        hz = a[2] * ew0 + b[2] * ew1 + d[2] * ew2
        p0, p1, p2 = a[0] * w0, b[0] * w1, d[0] * w2
        bxx = a[0] * p0 + b[0] * p1 + d[0] * p2
        bxy = a[1] * p0 + b[1] * p1 + d[1] * p2
        byy = a[1] * a[1] * w0 + b[1] * b[1] * w1 + d[1] * d[1] * w2
        fa0, fb0, fd0 = a[0] - u * a[2], b[0] - u * b[2], d[0] - u * d[2]
        fa1, fb1, fd1 = a[1] - v * a[2], b[1] - v * b[2], d[1] - v * d[2]
        p0, p1, p2 = fa0 * others0, fb0 * others1, fd0 * others2
        fxx = fa0 * p0 + fb0 * p1 + fd0 * p2
        fxy = fa1 * p0 + fb1 * p1 + fd1 * p2
        fyy = fa1 * fa1 * others0 + fb1 * fb1 * others1 + fd1 * fd1 * others2
        cov_zz = a[2] * a[2] * var0 + b[2] * b[2] * var1 + d[2] * d[2] * var2

        # Gradients on the sums.
        ia = 1.0 / a0
        zz = z * z
        scale_xx, scale_xy, scale_yy = ia * ifx * ifx, ia * ifx * ify, ia * ify * ify
        g_fyy = m[_GRAD + 2 * BLOCK + lane] * zz * scale_xx
        g_fxy = -2.0 * m[_GRAD + 3 * BLOCK + lane] * zz * scale_xy
        g_fxx = m[_GRAD + 4 * BLOCK + lane] * zz * scale_yy
        conic = g_fyy * fyy + g_fxy * fxy + g_fxx * fxx
        g_z = m[_GRAD + 10 * BLOCK + lane] + 2.0 * conic * inverse_z
        g_hx = m[_GRAD + 5 * BLOCK + lane] * ia * ifx
        g_hy = m[_GRAD + 6 * BLOCK + lane] * ia * ify
        g_bxx = m[_GRAD + 7 * BLOCK + lane] * scale_xx
        g_bxy = 2.0 * m[_GRAD + 8 * BLOCK + lane] * scale_xy
        g_byy = m[_GRAD + 9 * BLOCK + lane] * scale_yy
        quotients = conic + g_hx * hx + g_hy * hy + g_bxx * bxx + g_bxy * bxy + g_byy * byy
        g_a0 = m[_GRAD + 12 * BLOCK + lane] - quotients * ia
        flip = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
        nx, ny, nz = hx * flip, hy * flip, hz * flip
        gx, gy, gz = in_camera(
            c, m[_GRAD + 19 * BLOCK + lane], m[_GRAD + 20 * BLOCK + lane],
            m[_GRAD + 21 * BLOCK + lane],
        )  # fmt: skip
        along = gx * nx + gy * ny + gz * nz
        g_h = (
            g_hx - (gx - along * nx) * flip, g_hy - (gy - along * ny) * flip,
            (along * nz - gz) * flip,
        )  # fmt: skip
        g_b, g_f = (g_bxx, g_bxy, g_byy), (g_fxx, g_fxy, g_fyy)
        g_cov = 0.5 * m[_GRAD + 22 * BLOCK + lane] / math.sqrt(cov_zz)

        # Gradients on axes, weights and the ray through the mean.
        ga = _axis_gradient(a, e0, fa0, fa1, w0, others0, var0 * g_cov, g_a0, g_h, g_b, g_f)
        gb = _axis_gradient(b, e1, fb0, fb1, w1, others1, var1 * g_cov, g_a0, g_h, g_b, g_f)
        gd = _axis_gradient(d, e2, fd0, fd1, w2, others2, var2 * g_cov, g_a0, g_h, g_b, g_f)
        g_u = m[_GRAD + lane] * fx + a[0] * ga[0] + b[0] * gb[0] + d[0] * gd[0]
        g_u -= a[2] * ga[1] + b[2] * gb[1] + d[2] * gd[1]
        g_v = m[_GRAD + BLOCK + lane] * fy + a[1] * ga[0] + b[1] * gb[0] + d[1] * gd[0]
        g_v -= a[2] * ga[2] + b[2] * gb[2] + d[2] * gd[2]
        m[_GRAD_SCALE + lane] = ga[6] + gb[7] + gd[7]
        m[_GRAD_SCALE + BLOCK + lane] = gb[6] + ga[7] + gd[7]
        m[_GRAD_SCALE + 2 * BLOCK + lane] = gd[6] + ga[7] + gb[7]
        gx, gy = g_u * inverse_z, g_v * inverse_z
        gz = g_z - gx * u - gy * v
        m[_GRAD_MEAN + lane] = c[0] * gx + c[3] * gy + c[6] * gz
        m[_GRAD_MEAN + BLOCK + lane] = c[1] * gx + c[4] * gy + c[7] * gz
        m[_GRAD_MEAN + 2 * BLOCK + lane] = c[2] * gx + c[5] * gy + c[8] * gz
        # The rotation's columns are the axes in the scene frame.
        x, y = ga[3] + ga[1] + u * ga[0], ga[4] + ga[2] + v * ga[0]
        z = ga[5] + ga[0] - u * ga[1] - v * ga[2]
        m[ROTATION + lane] = c[0] * x + c[3] * y + c[6] * z
        m[ROTATION + 3 * BLOCK + lane] = c[1] * x + c[4] * y + c[7] * z
        m[ROTATION + 6 * BLOCK + lane] = c[2] * x + c[5] * y + c[8] * z
        x, y = gb[3] + gb[1] + u * gb[0], gb[4] + gb[2] + v * gb[0]
        z = gb[5] + gb[0] - u * gb[1] - v * gb[2]
        m[ROTATION + BLOCK + lane] = c[0] * x + c[3] * y + c[6] * z
        m[ROTATION + 4 * BLOCK + lane] = c[1] * x + c[4] * y + c[7] * z
        m[ROTATION + 7 * BLOCK + lane] = c[2] * x + c[5] * y + c[8] * z
        x, y = gd[3] + gd[1] + u * gd[0], gd[4] + gd[2] + v * gd[0]
        z = gd[5] + gd[0] - u * gd[1] - v * gd[2]
        m[ROTATION + 2 * BLOCK + lane] = c[0] * x + c[3] * y + c[6] * z
        m[ROTATION + 5 * BLOCK + lane] = c[1] * x + c[4] * y + c[7] * z
        m[ROTATION + 8 * BLOCK + lane] = c[2] * x + c[5] * y + c[8] * z


@part(fast=False, fused=True)
def _raw_gradients(m: Any) -> None:
    """Propagate gradients from activated to raw values, including those of the view direction."""
    for lane in range(BLOCK):
        w, x = m[QUAT + lane], m[QUAT + BLOCK + lane]
        y, z = m[QUAT + 2 * BLOCK + lane], m[QUAT + 3 * BLOCK + lane]
        square = w * w + x * x + y * y + z * z
        degenerate = square <= _QUATERNION_MIN_SQ
        inverse = 1.0 / math.sqrt(square)
        inverse = 0.0 if degenerate else inverse
        w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
        g00, g11, g22 = (
            m[ROTATION + lane], m[ROTATION + 4 * BLOCK + lane], m[ROTATION + 8 * BLOCK + lane],
        )  # fmt: skip
        g01, g10 = m[ROTATION + BLOCK + lane], m[ROTATION + 3 * BLOCK + lane]
        g02, g20 = m[ROTATION + 2 * BLOCK + lane], m[ROTATION + 6 * BLOCK + lane]
        g12, g21 = m[ROTATION + 5 * BLOCK + lane], m[ROTATION + 7 * BLOCK + lane]
        skew_x, skew_y, skew_z = g21 - g12, g02 - g20, g10 - g01
        sum_xy, sum_xz, sum_yz = g01 + g10, g02 + g20, g12 + g21
        gw = x * skew_x + y * skew_y + z * skew_z
        gx = w * skew_x + y * sum_xy + z * sum_xz - 2.0 * x * (g11 + g22)
        gy = w * skew_y + x * sum_xy + z * sum_yz - 2.0 * y * (g00 + g22)
        gz = w * skew_z + x * sum_xz + y * sum_yz - 2.0 * z * (g00 + g11)
        along = gw * w + gx * x + gy * y + gz * z
        inverse = 2.0 * inverse
        m[_GRAD_QUAT + lane] = (gw - along * w) * inverse
        m[_GRAD_QUAT + BLOCK + lane] = (gx - along * x) * inverse
        m[_GRAD_QUAT + 2 * BLOCK + lane] = (gy - along * y) * inverse
        m[_GRAD_QUAT + 3 * BLOCK + lane] = (gz - along * z) * inverse
    for lane in range(BLOCK):
        # d(effective log scale) = raw share * d(log scale); the filter also reduces the opacity.
        g = m[_GRAD + 11 * BLOCK + lane] * m[OPACITY + lane]
        m[_GRAD_LOGIT + lane] = g * m[TRANSPARENCY + lane]
        k0, k1, k2 = (
            m[RAW_SHARE + lane], m[RAW_SHARE + BLOCK + lane], m[RAW_SHARE + 2 * BLOCK + lane],
        )  # fmt: skip
        m[_GRAD_SCALE + lane] = k0 * m[_GRAD_SCALE + lane] + (1.0 - k0) * g
        m[_GRAD_SCALE + BLOCK + lane] = k1 * m[_GRAD_SCALE + BLOCK + lane] + (1.0 - k1) * g
        m[_GRAD_SCALE + 2 * BLOCK + lane] = k2 * m[_GRAD_SCALE + 2 * BLOCK + lane] + (1.0 - k2) * g
        # Learned normal tanh(s) d / |d|.
        n0, n1 = m[ORIENTATION + lane], m[ORIENTATION + BLOCK + lane]
        n2 = m[ORIENTATION + 2 * BLOCK + lane]
        g0, g1 = m[_GRAD + 16 * BLOCK + lane], m[_GRAD + 17 * BLOCK + lane]
        g2 = m[_GRAD + 18 * BLOCK + lane]
        along = g0 * n0 + g1 * n1 + g2 * n2
        inverse = m[TANH + lane] * m[ORIENTATION + 3 * BLOCK + lane]
        m[_GRAD_ORIENTATION + lane] = (g0 - along * n0) * inverse
        m[_GRAD_ORIENTATION + BLOCK + lane] = (g1 - along * n1) * inverse
        m[_GRAD_ORIENTATION + 2 * BLOCK + lane] = (g2 - along * n2) * inverse
        m[_GRAD_ORIENTATION + 3 * BLOCK + lane] = m[SLOPE + lane] * along
    for lane in range(BLOCK):
        d0, d1 = m[RAY + lane], m[RAY + BLOCK + lane]
        d2, inverse = m[RAY + 2 * BLOCK + lane], m[RAY + 3 * BLOCK + lane]
        g0, g1, g2 = direction_gradient(m, _WEIGHT, lane, d0, d1, d2)
        along = g0 * d0 + g1 * d1 + g2 * d2
        m[_GRAD_MEAN + lane] += (g0 - along * d0) * inverse
        m[_GRAD_MEAN + BLOCK + lane] += (g1 - along * d1) * inverse
        m[_GRAD_MEAN + 2 * BLOCK + lane] += (g2 - along * d2) * inverse


@part(fast=False, fused=True)
def _drop_overflows(m: Any) -> None:
    """Set all gradients of a Gaussian to 0 if any of them overflows float32."""
    for lane in range(BLOCK):
        # NaN and infinity propagate through a sum of absolute values.
        red, green = m[_GRAD + 13 * BLOCK + lane], m[_GRAD + 14 * BLOCK + lane]
        blue = m[_GRAD + 15 * BLOCK + lane]
        size = _BASIS_MAX * (abs(red) + abs(green) + abs(blue))
        for plane in range(_WRITTEN_PLANES):
            size += abs(m[_GRAD_MEAN + plane * BLOCK + lane])
        held = size < _GRADIENT_MAX
        for plane in range(_WRITTEN_PLANES):
            at = _GRAD_MEAN + plane * BLOCK + lane
            m[at] = m[at] if held else 0.0
        m[_GRAD + 13 * BLOCK + lane] = red if held else 0.0
        m[_GRAD + 14 * BLOCK + lane] = green if held else 0.0
        m[_GRAD + 15 * BLOCK + lane] = blue if held else 0.0


@kernel(fast=False, fused=True)
def backward_range(
    begin: int, end: int, ids: np.ndarray, compact: bool, means: np.ndarray, log_scales: np.ndarray,
    quats: np.ndarray, opacity_logits: np.ndarray, sh: np.ndarray, orientation: np.ndarray,
    filter_3d: np.ndarray, degree: int, camera: np.ndarray, params: np.ndarray, visible: np.ndarray,
    grad_params: np.ndarray, grad_means: np.ndarray, grad_log_scales: np.ndarray,
    grad_quats: np.ndarray, grad_opacity_logits: np.ndarray, grad_sh: np.ndarray,
    grad_orientation: np.ndarray,
) -> None:  # fmt: skip
    """Write the gradients of the Gaussians ``begin .. end``, or of ``ids[begin .. end]``.

    The gradient is 0 for Gaussians that are not visible or if it overflows float32. With
    ``compact`` row k of the ``grad_`` arrays is overwritten with the gradient of ``ids[k]``;
    without, ``ids`` is not read and the gradient of Gaussian i is added to row i.
    """
    m = block_scratch(_PLANES)
    m[_WEIGHT : _WEIGHT + BASIS_COUNT * BLOCK] = 0.0
    queue = np.empty(QUEUE + BLOCK, np.int64)
    coefficients = (degree + 1) * (degree + 1)
    at = begin
    while at < end:
        count = 0
        while at < end and count < QUEUE:
            i = np.int64(ids[at]) if compact else np.int64(at)
            if visible[i]:
                queue[count] = at
                count += 1
            elif compact:
                grad_means[at] = 0.0
                grad_log_scales[at] = 0.0
                grad_quats[at] = 0.0
                grad_opacity_logits[at] = 0.0
                grad_sh[at] = 0.0
                grad_orientation[at] = 0.0
            at += 1
        for pad in range(count, (count + BLOCK - 1) // BLOCK * BLOCK):
            queue[pad] = queue[count - 1]
        for first in range(0, count, BLOCK):
            for lane in range(BLOCK):
                row = queue[first + lane]
                i = np.int64(ids[row]) if compact else row
                load_raw(
                    m, lane, i, means, log_scales, quats, opacity_logits, orientation, filter_3d
                )
                for column in range(_USED_COLUMNS):
                    m[_GRAD + column * BLOCK + lane] = grad_params[i, column]
            activate_block(m, camera)
            _shape_gradients(m, camera)
            for lane in range(min(BLOCK, count - first)):
                row = queue[first + lane]
                i = np.int64(ids[row]) if compact else row
                # A colour clamped to 0 has no gradient.
                red = m[_GRAD + 13 * BLOCK + lane] if params[i, 13] > 0.0 else 0.0
                green = m[_GRAD + 14 * BLOCK + lane] if params[i, 14] > 0.0 else 0.0
                blue = m[_GRAD + 15 * BLOCK + lane] if params[i, 15] > 0.0 else 0.0
                for k in range(coefficients):
                    m[_WEIGHT + k * BLOCK + lane] = (
                        red * np.float64(sh[i, k, 0])
                        + green * np.float64(sh[i, k, 1])
                        + blue * np.float64(sh[i, k, 2])
                    )
                m[_GRAD + 13 * BLOCK + lane] = red
                m[_GRAD + 14 * BLOCK + lane] = green
                m[_GRAD + 15 * BLOCK + lane] = blue
            _raw_gradients(m)
            _drop_overflows(m)
            for lane in range(min(BLOCK, count - first)):
                row = queue[first + lane]
                red, green = m[_GRAD + 13 * BLOCK + lane], m[_GRAD + 14 * BLOCK + lane]
                blue = m[_GRAD + 15 * BLOCK + lane]
                if compact:
                    for k in range(coefficients):
                        value = m[BASIS + k * BLOCK + lane]
                        grad_sh[row, k, 0] = red * value
                        grad_sh[row, k, 1] = green * value
                        grad_sh[row, k, 2] = blue * value
                    for k in range(coefficients, sh.shape[1]):
                        grad_sh[row, k, 0] = 0.0
                        grad_sh[row, k, 1] = 0.0
                        grad_sh[row, k, 2] = 0.0
                else:
                    for k in range(coefficients):
                        value = m[BASIS + k * BLOCK + lane]
                        grad_sh[row, k, 0] += red * value
                        grad_sh[row, k, 1] += green * value
                        grad_sh[row, k, 2] += blue * value
                if compact:
                    grad_opacity_logits[row] = m[_GRAD_LOGIT + lane]
                    for axis in range(3):
                        grad_means[row, axis] = m[_GRAD_MEAN + axis * BLOCK + lane]
                        grad_log_scales[row, axis] = m[_GRAD_SCALE + axis * BLOCK + lane]
                    for axis in range(4):
                        grad_quats[row, axis] = m[_GRAD_QUAT + axis * BLOCK + lane]
                        grad_orientation[row, axis] = m[_GRAD_ORIENTATION + axis * BLOCK + lane]
                else:
                    grad_opacity_logits[row] += m[_GRAD_LOGIT + lane]
                    for axis in range(3):
                        grad_means[row, axis] += m[_GRAD_MEAN + axis * BLOCK + lane]
                        grad_log_scales[row, axis] += m[_GRAD_SCALE + axis * BLOCK + lane]
                    for axis in range(4):
                        grad_quats[row, axis] += m[_GRAD_QUAT + axis * BLOCK + lane]
                        grad_orientation[row, axis] += m[_GRAD_ORIENTATION + axis * BLOCK + lane]


# -- Projection of Gaussians onto the screen of a camera, and its analytic gradient ---------------


@dataclass(frozen=True)
class RawArrays:
    """The raw parameters of :class:`OrientedGaussians` as C-contiguous arrays of one float type.

    float32 and float64 are both read without conversion.
    """

    means: np.ndarray  # (n, 3)
    log_scales: np.ndarray  # (n, 3)
    quats: np.ndarray  # (n, 4)
    opacity_logits: np.ndarray  # (n,)
    sh: np.ndarray  # (n, k, 3)
    orientation: np.ndarray  # (n, 4)
    filter_3d: np.ndarray  # (n,)

    def __len__(self) -> int:
        return len(self.means)

    @classmethod
    def from_gaussians(cls, gaussians: OrientedGaussians) -> RawArrays:
        """Share the memory of contiguous CPU tensors; copy others."""

        def array(tensor: Tensor) -> np.ndarray:
            return tensor.detach().cpu().contiguous().numpy()

        return cls(**{name: array(tensor) for name, tensor in gaussians.tensors()})

    def arguments(self) -> tuple[np.ndarray, ...]:
        """Return the arrays in the argument order of the kernels."""
        return (
            self.means, self.log_scales, self.quats, self.opacity_logits, self.sh,
            self.orientation, self.filter_3d,
        )  # fmt: skip


@dataclass(frozen=True)
class RawGradients:
    """Gradients of a scalar with respect to :class:`RawArrays` (``filter_3d`` is a constant)."""

    means: np.ndarray  # (n, 3)
    log_scales: np.ndarray  # (n, 3)
    quats: np.ndarray  # (n, 4)
    opacity_logits: np.ndarray  # (n,)
    sh: np.ndarray  # (n, k, 3)
    orientation: np.ndarray  # (n, 4)

    @classmethod
    def zeros(cls, gaussians: RawArrays) -> RawGradients:
        """Return zero gradients of the Gaussians' shapes and float type."""
        return cls(*(np.zeros_like(getattr(gaussians, name)) for name in TRAINED))


@dataclass(frozen=True)
class ScreenGaussians:
    """Gaussians on the screen of one camera; layout in ``docs/architecture.md``.

    Of Gaussians that are not visible only ``visible`` and ``depths`` (inf) are written. Their other
    values are those that the arrays held before, which are finite: 0, or another view's values.
    """

    params: np.ndarray
    """(n, 24) float32; undefined where not visible."""
    boxes: np.ndarray
    """(n, 4) float32: x0 y0 x1 y1 of the ellipse ``alpha >= 1/255``, pixels, rounded outwards;
    undefined where not visible."""
    visible: np.ndarray
    """(n,) bool: the box contains a pixel centre of the image."""
    depths: np.ndarray
    """(n,) float32: distance from the camera to the mean, the sort key of the blending order; inf
    where not visible."""
    skews: np.ndarray
    """(n,) float32: x offset from the box's centre to the ellipse's lowest point (largest y),
    pixels; inf where the ellipse is unbounded and the box is the whole image; undefined where not
    visible."""

    def __len__(self) -> int:
        return len(self.params)

    @classmethod
    def allocate(cls, count: int) -> ScreenGaussians:
        """Return arrays for ``count`` Gaussians, none visible; pass them as ``out`` to reuse."""
        return cls(
            np.zeros((count, PARAM_COLUMNS), np.float32), np.zeros((count, 4), np.float32),
            np.zeros(count, np.bool_), np.full(count, np.inf, np.float32),
            np.zeros(count, np.float32),
        )  # fmt: skip

    def arguments(self) -> tuple[np.ndarray, ...]:
        """Return the arrays in the argument order of the kernels."""
        return self.params, self.boxes, self.visible, self.depths, self.skews


def pack_camera(camera: Camera, near_z: float) -> np.ndarray:
    """Return the (22,) float64 camera vector of the projection kernels."""
    values = np.zeros(CAMERA_VALUES)
    values[0:9] = camera.rotation.reshape(-1)
    values[9:12] = camera.cam_from_world[:, 3]
    values[12:15] = camera.center
    values[15:19] = camera.fx, camera.fy, camera.cx, camera.cy
    values[19:22] = camera.width, camera.height, near_z
    return values


def used_degree(coefficients: int, options: RenderOptions) -> int:
    """Return the degree of the harmonics that a rendering uses.

    Raises UsageError if ``coefficients`` is not 1, 4, 9 or 16.
    """
    stored = round(coefficients**0.5) - 1
    if (stored + 1) ** 2 != coefficients or not 0 <= stored <= MAX_DEGREE:
        raise UsageError(
            f"Gaussians hold {coefficients} harmonics coefficients.", "Give 1, 4, 9 or 16."
        )
    return stored if options.sh_degree is None else max(0, min(stored, options.sh_degree))


def project_gaussians(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    out: ScreenGaussians | None = None,
) -> ScreenGaussians:
    """Activate and project raw Gaussians, in float64 (docs/method.md, sections 1.5 and 2.3).

    Gaussians and camera are in the scene frame; of the options ``near_z``, ``sh_degree`` and
    ``threads`` are used. With ``out``, arrays of the same length, only a few kilobytes are
    allocated.

    Not visible are Gaussians nearer than ``near_z``, fainter than 1/255, outside the image, between
    pixel centres, or with non-finite values.
    """
    count = len(gaussians)
    screen = ScreenGaussians.allocate(count) if out is None else out
    if len(screen) != count:
        raise UsageError(f"The output holds {len(screen)} rows, not {count}.", "Allocate it anew.")
    _run(
        project_raw_range, count, options.threads, *_raw_arguments(gaussians, camera, options),
        *screen.arguments(),
    )  # fmt: skip
    return screen


def project_arrays(
    arrays: GaussianArrays, camera: Camera, near_z: float, *, threads: int = 0
) -> ScreenGaussians:
    """Project activated Gaussians like :func:`project_gaussians`; the colour columns are 0."""
    screen = ScreenGaussians.allocate(len(arrays))
    _run(
        project_activated_range, len(arrays), threads, arrays.means, arrays.scales,
        arrays.rotations, arrays.log_opacities, arrays.normals, pack_camera(camera, near_z),
        *screen.arguments(),
    )  # fmt: skip
    return screen


def project_backward(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    screen: ScreenGaussians,
    grad_params: np.ndarray,
    grads_out: RawGradients,
) -> None:
    """Add the gradient with respect to the raw parameters to ``grads_out``; computed in float64.

    ``screen`` is the unmodified result of :func:`project_gaussians`, of which only rows of visible
    Gaussians are read: a colour of 0 there was clamped and has no gradient. ``grad_params (n, 24)``
    float32 or float64 is the gradient on its params, whose column 23 is ignored. A direction of
    length 0 and a degenerate quaternion have gradient 0.
    """
    _backward(gaussians, camera, options, screen, grad_params, None, grads_out)


def project_backward_visible(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    screen: ScreenGaussians,
    grad_params: np.ndarray,
    ids: np.ndarray,
    take: Callable[[str, tuple[int, ...], Any], np.ndarray] | None = None,
) -> VisibleGradients:
    """Return the gradient with respect to the raw parameters of some Gaussians, one row each.

    Arguments as for :func:`project_backward`, of whose ``grad_params`` only the rows
    ``ids (v,) int32``, increasing, are read. Those that are not visible get rows of 0, as do
    coefficients above the degree used. ``take(name, shape, dtype)`` returns the arrays to write; by
    default new ones.
    """
    rows = [
        np.empty(shape, np.float32) if take is None else take(f"grad {name}", shape, np.float32)
        for name in TRAINED
        for shape in [(len(ids), *getattr(gaussians, name).shape[1:])]
    ]
    out = VisibleGradients(ids, *rows)
    _backward(gaussians, camera, options, screen, grad_params, ids, out)
    return out


_NO_IDS = np.zeros(0, np.int32)


def _backward(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    screen: ScreenGaussians,
    grad_params: np.ndarray,
    ids: np.ndarray | None,
    grads_out: RawGradients | VisibleGradients,
) -> None:
    """Run the backward kernel: write the rows of ``ids``, or add to those of all Gaussians."""
    _run(
        backward_range, len(gaussians) if ids is None else len(ids), options.threads,
        _NO_IDS if ids is None else ids, ids is not None,
        *_raw_arguments(gaussians, camera, options), screen.params, screen.visible, grad_params,
        *(getattr(grads_out, name) for name in TRAINED),
    )  # fmt: skip


def _raw_arguments(gaussians: RawArrays, camera: Camera, options: RenderOptions) -> tuple[Any, ...]:
    """Return what the kernels of raw Gaussians share, in their order."""
    degree = used_degree(gaussians.sh.shape[1], options)
    return *gaussians.arguments(), degree, pack_camera(camera, options.near_z)


def _run(kernel: Any, count: int, threads: int, *arguments: Any) -> None:
    """Run a kernel over ``count`` Gaussians, in chunks; 0 threads use every core."""
    threads = threads or default_threads()
    run_chunks(
        lambda begin, end: kernel(begin, end, *arguments), even_bounds(count, threads), threads
    )
