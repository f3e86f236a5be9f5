# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled forward projection: Gaussians of any depth-to-size ratio onto one screen, in float64.

Notation of method.md 1.1 with ``w0 = (u, v, 1)`` the ray through the mean (camera frame),
``axis_k`` the Gaussian's axes and ``e_k = axis_k . w0``. The inverse covariance of the exact
projection is written as a sum of squares,

    Q = z^2 / a0 * sum_k (s_i s_j)^-2 g_k g_k^T,   (i, j) the other two axes,

so neither a grazing disc nor an anisotropy of 1e6 cancels. The screen box is that of the ellipse
``alpha >= 1/255``, from the dual conic of the ellipsoid: it is bounded exactly while the whole
ellipsoid lies in front of the camera plane.
"""

from __future__ import annotations

import math

import numpy as np

from .. import tolerances
from ..compiled import kernel
from .harmonics_kernels import basis

PARAM_COLUMNS = 24
CAMERA_VALUES = 22
"""Packed camera: rotation 0-8, translation 9-11, centre 12-14, fx fy cx cy 15-18, width height
19-20, near z 21."""

_ALPHA_MIN = tolerances.ALPHA_MIN
_QUATERNION_MIN_NORM = tolerances.QUATERNION_MIN_NORM
_DIRECTION_MIN_NORM = tolerances.DIRECTION_MIN_NORM
# An ellipsoid that touches the camera plane within rounding is treated as crossing it.
_PLANE_MARGIN = 1e-12
_FLOAT32_MAX = 3.0e38
_FLOAT32_STEP = 2.0**-23
# Boxes end here so that pixel ranges always fit an int32.
_FARTHEST_PX = 1.0e9


@kernel(fast=False)
def rotation_from_quat(w: float, x: float, y: float, z: float, out: np.ndarray) -> float:
    """Write the (3, 3) rotation of a quaternion; return its norm, or 0 where it is degenerate."""
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm <= _QUATERNION_MIN_NORM:
        w, x, y, z = 1.0, 0.0, 0.0, 0.0
        norm = 0.0
    else:
        w, x, y, z = w / norm, x / norm, y / norm, z / norm
    out[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    out[0, 1] = 2.0 * (x * y - w * z)
    out[0, 2] = 2.0 * (x * z + w * y)
    out[1, 0] = 2.0 * (x * y + w * z)
    out[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    out[1, 2] = 2.0 * (y * z - w * x)
    out[2, 0] = 2.0 * (x * z - w * y)
    out[2, 1] = 2.0 * (y * z + w * x)
    out[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return norm


@kernel(fast=False)
def _outward(value: float, side: float) -> float:
    """Move a box edge one float32 step outwards (``side`` -1 or 1), so that rounding is safe."""
    value = min(max(value, -_FARTHEST_PX), _FARTHEST_PX)
    return value + side * _FLOAT32_STEP * abs(value)


@kernel(fast=False)
def _hide(
    i: int, params: np.ndarray, boxes: np.ndarray, depths: np.ndarray, skews: np.ndarray
) -> None:
    """Leave an invisible row without stale values."""
    params[i] = 0.0
    boxes[i, 0] = boxes[i, 1] = 0.0
    boxes[i, 2] = boxes[i, 3] = -1.0
    depths[i] = np.inf
    skews[i] = 0.0


@kernel(fast=False)
def _project_shape(
    i: int,
    x: float,
    y: float,
    z: float,
    rotation: np.ndarray,
    variances: np.ndarray,
    opacity: float,
    camera: np.ndarray,
    axes: np.ndarray,
    params: np.ndarray,
    boxes: np.ndarray,
    depths: np.ndarray,
    skews: np.ndarray,
) -> bool:
    """Write columns 0-12 and 19-22, box, depth and skew of one Gaussian; return whether visible.

    ``(x, y, z)`` is the mean in the camera frame, ``axes (3, 3)`` is scratch.
    """
    fx, fy, cx, cy = camera[15], camera[16], camera[17], camera[18]
    width, height, near_z = camera[19], camera[20], camera[21]
    if not (z > near_z and z > 0.0 and opacity > _ALPHA_MIN):
        return False
    u, v = x / z, y / z
    for k in range(3):
        for row in range(3):
            axes[row, k] = (
                camera[3 * row] * rotation[0, k]
                + camera[3 * row + 1] * rotation[1, k]
                + camera[3 * row + 2] * rotation[2, k]
            )
    a0 = hx = hy = hz = bxx = bxy = byy = 0.0
    qxx = qxy = qyy = 0.0
    cov_xx = cov_xy = cov_yy = cov_xz = cov_yz = cov_zz = 0.0
    for k in range(3):
        r0, r1, r2 = axes[0, k], axes[1, k], axes[2, k]
        variance = variances[k]
        inverse = 1.0 / variance
        inverse_others = 1.0 / (variances[(k + 1) % 3] * variances[(k + 2) % 3])
        e = r0 * u + r1 * v + r2
        f0, f1 = r0 - u * r2, r1 - v * r2
        a0 += e * e * inverse
        hx += r0 * e * inverse
        hy += r1 * e * inverse
        hz += r2 * e * inverse
        bxx += r0 * r0 * inverse
        bxy += r0 * r1 * inverse
        byy += r1 * r1 * inverse
        qxx += f1 * f1 * inverse_others
        qxy -= f0 * f1 * inverse_others
        qyy += f0 * f0 * inverse_others
        cov_xx += f0 * f0 * variance
        cov_xy += f0 * f1 * variance
        cov_yy += f1 * f1 * variance
        cov_xz += f0 * r2 * variance
        cov_yz += f1 * r2 * variance
        cov_zz += r2 * r2 * variance
    inverse_a0 = 1.0 / a0
    zz = z * z
    params[i, 0] = fx * u + cx
    params[i, 1] = fy * v + cy
    params[i, 2] = zz * qxx * inverse_a0 / (fx * fx)
    params[i, 3] = 2.0 * zz * qxy * inverse_a0 / (fx * fy)
    params[i, 4] = zz * qyy * inverse_a0 / (fy * fy)
    params[i, 5] = hx * inverse_a0 / fx
    params[i, 6] = hy * inverse_a0 / fy
    params[i, 7] = bxx * inverse_a0 / (fx * fx)
    params[i, 8] = 2.0 * bxy * inverse_a0 / (fx * fy)
    params[i, 9] = byy * inverse_a0 / (fy * fy)
    params[i, 10] = z
    params[i, 11] = opacity
    params[i, 12] = a0
    length = -1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx * length, hy * length, hz * length
    for column in range(3):
        params[i, 19 + column] = (
            camera[column] * hx + camera[3 + column] * hy + camera[6 + column] * hz
        )
    params[i, 22] = math.sqrt(cov_zz)
    params[i, 23] = 0.0
    depths[i] = math.sqrt(x * x + y * y + zz)

    threshold = 2.0 * math.log(opacity / _ALPHA_MIN)
    scale = zz - threshold * cov_zz
    if scale > _PLANE_MARGIN * zz:
        # The silhouette's dual conic, seen from (u, v): centre and half axes of the ellipse.
        share = threshold / scale
        center_x = fx * (u - share * cov_xz) + cx
        center_y = fy * (v - share * cov_yz) + cy
        spread_xx = share * (cov_xx + share * cov_xz * cov_xz)
        spread_xy = share * (cov_xy + share * cov_xz * cov_yz)
        spread_yy = share * (cov_yy + share * cov_yz * cov_yz)
        half_x, half_y = fx * math.sqrt(spread_xx), fy * math.sqrt(spread_yy)
        boxes[i, 0] = _outward(center_x - half_x, -1.0)
        boxes[i, 1] = _outward(center_y - half_y, -1.0)
        boxes[i, 2] = _outward(center_x + half_x, 1.0)
        boxes[i, 3] = _outward(center_y + half_y, 1.0)
        skews[i] = fx * spread_xy / math.sqrt(spread_yy)
    else:
        boxes[i, 0] = boxes[i, 1] = 0.0
        boxes[i, 2] = width
        boxes[i, 3] = height
        skews[i] = np.inf

    # Seen if the box holds the centre of a pixel of the image.
    first_x = max(np.ceil(boxes[i, 0] - 0.5), 0.0)
    last_x = min(np.floor(boxes[i, 2] - 0.5), width - 1.0)
    first_y = max(np.ceil(boxes[i, 1] - 0.5), 0.0)
    last_y = min(np.floor(boxes[i, 3] - 0.5), height - 1.0)
    return first_x <= last_x and first_y <= last_y


@kernel(fast=False)
def _row_is_finite(i: int, params: np.ndarray, boxes: np.ndarray) -> bool:
    """Return whether every value of a row is a usable float32."""
    for column in range(PARAM_COLUMNS):
        if not abs(params[i, column]) < _FLOAT32_MAX:
            return False
    for column in range(4):  # noqa: SIM110 - numba compiles loops, not generators
        if not abs(boxes[i, column]) < _FLOAT32_MAX:
            return False
    return True


@kernel(fast=False)
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
    """Project the raw Gaussians ``begin .. end``; every array is written in place."""
    rotation = np.zeros((3, 3))
    axes = np.zeros((3, 3))
    variances = np.zeros(3)
    harmonics = np.zeros(16)
    for i in range(begin, end):
        m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = camera[6] * m0 + camera[7] * m1 + camera[8] * m2 + camera[11]
        seen = z > camera[21]
        if seen:
            x = camera[0] * m0 + camera[1] * m1 + camera[2] * m2 + camera[9]
            y = camera[3] * m0 + camera[4] * m1 + camera[5] * m2 + camera[10]
            rotation_from_quat(
                np.float64(quats[i, 0]),
                np.float64(quats[i, 1]),
                np.float64(quats[i, 2]),
                np.float64(quats[i, 3]),
                rotation,
            )
            filter_sq = np.float64(filter_3d[i]) * np.float64(filter_3d[i])
            kept = 1.0
            for k in range(3):
                raw = math.exp(2.0 * np.float64(log_scales[i, k]))
                variances[k] = raw + filter_sq
                kept *= raw / variances[k]
            opacity = math.sqrt(kept) / (1.0 + math.exp(-np.float64(opacity_logits[i])))
            seen = _project_shape(
                i, x, y, z, rotation, variances, opacity, camera, axes, params, boxes, depths, skews
            )
        if seen:
            d0, d1, d2 = m0 - camera[12], m1 - camera[13], m2 - camera[14]
            distance = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            basis(degree, d0 / distance, d1 / distance, d2 / distance, harmonics)
            for channel in range(3):
                value = 0.5
                for k in range((degree + 1) * (degree + 1)):
                    value += harmonics[k] * np.float64(sh[i, k, channel])
                # Written so that NaN stays NaN and hides the row below.
                params[i, 13 + channel] = 0.0 if value <= 0.0 else value
            n0, n1, n2 = (
                np.float64(orientation[i, 0]),
                np.float64(orientation[i, 1]),
                np.float64(orientation[i, 2]),
            )
            length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            gain = math.tanh(np.float64(orientation[i, 3])) / max(length, _DIRECTION_MIN_NORM)
            params[i, 16], params[i, 17], params[i, 18] = gain * n0, gain * n1, gain * n2
            seen = _row_is_finite(i, params, boxes)
        visible[i] = seen
        if not seen:
            _hide(i, params, boxes, depths, skews)


@kernel(fast=False)
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
    """Project the activated Gaussians ``begin .. end``; the colour columns stay 0."""
    axes = np.zeros((3, 3))
    variances = np.zeros(3)
    for i in range(begin, end):
        m0, m1, m2 = means[i, 0], means[i, 1], means[i, 2]
        x = camera[0] * m0 + camera[1] * m1 + camera[2] * m2 + camera[9]
        y = camera[3] * m0 + camera[4] * m1 + camera[5] * m2 + camera[10]
        z = camera[6] * m0 + camera[7] * m1 + camera[8] * m2 + camera[11]
        for k in range(3):
            variances[k] = scales[i, k] * scales[i, k]
        opacity = math.exp(log_opacities[i])
        seen = _project_shape(
            i, x, y, z, rotations[i], variances, opacity, camera, axes, params, boxes, depths, skews
        )
        if seen:
            for channel in range(3):
                params[i, 13 + channel] = 0.0
                params[i, 16 + channel] = normals[i, channel]
            seen = _row_is_finite(i, params, boxes)
        visible[i] = seen
        if not seen:
            _hide(i, params, boxes, depths, skews)
