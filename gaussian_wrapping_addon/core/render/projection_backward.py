# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled analytic gradient of the projection, the reverse of ``projection_kernels.py``.

With ``weight_k = 1 / scale_k^2`` everything the forward writes is built of

    e_k = axis_k . w0,           h = sum_k axis_k e_k weight_k,     a0 = sum_k e_k^2 weight_k,
    B = sum_k (r0, r1)_k (r0, r1)_k^T weight_k,
    F = sum_k f_k f_k^T weight_i weight_j,   f_k = (r0 - u r2, r1 - v r2)_k,   (i, j) != k;

the gradient is gathered on a0, h, B, F and (u, v, z) first, then on axes and log weights.
"""

from __future__ import annotations

import math

import numpy as np

from .. import tolerances
from ..compiled import kernel
from .harmonics_kernels import basis, basis_gradient
from .projection_kernels import rotation_from_quat

_DIRECTION_MIN_NORM = tolerances.DIRECTION_MIN_NORM


@kernel(fast=False)
def _quat_gradient(
    w: float, x: float, y: float, z: float, norm: float, g: np.ndarray, out: np.ndarray
) -> None:
    """Write the gradient on a raw quaternion of length ``norm`` from that on its rotation."""
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    out[0] = 2.0 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    out[1] = 2.0 * (
        w * (g[2, 1] - g[1, 2])
        + y * (g[0, 1] + g[1, 0])
        + z * (g[0, 2] + g[2, 0])
        - 2.0 * x * (g[1, 1] + g[2, 2])
    )
    out[2] = 2.0 * (
        w * (g[0, 2] - g[2, 0])
        + x * (g[0, 1] + g[1, 0])
        + z * (g[1, 2] + g[2, 1])
        - 2.0 * y * (g[0, 0] + g[2, 2])
    )
    out[3] = 2.0 * (
        w * (g[1, 0] - g[0, 1])
        + x * (g[0, 2] + g[2, 0])
        + y * (g[1, 2] + g[2, 1])
        - 2.0 * z * (g[0, 0] + g[1, 1])
    )
    along = out[0] * w + out[1] * x + out[2] * y + out[3] * z
    out[0] = (out[0] - along * w) / norm
    out[1] = (out[1] - along * x) / norm
    out[2] = (out[2] - along * y) / norm
    out[3] = (out[3] - along * z) / norm


@kernel(fast=False)
def _shape_gradient(
    x: float,
    y: float,
    z: float,
    variances: np.ndarray,
    camera: np.ndarray,
    axes: np.ndarray,
    grad: np.ndarray,
    grad_axes: np.ndarray,
    grad_logs: np.ndarray,
    grad_mean: np.ndarray,
) -> None:
    """From the gradient on one row of params to axes, log scales and mean, camera frame.

    ``grad (24,)`` is read; ``grad_axes (3, 3)``, ``grad_logs (3,)`` (effective log scales) and
    ``grad_mean (3,)`` are written.
    """
    fx, fy = camera[15], camera[16]
    u, v = x / z, y / z
    a0 = hx = hy = hz = bxx = bxy = byy = 0.0
    fxx = fxy = fyy = cov_zz = 0.0
    for k in range(3):
        r0, r1, r2 = axes[0, k], axes[1, k], axes[2, k]
        weight = 1.0 / variances[k]
        weight_others = 1.0 / (variances[(k + 1) % 3] * variances[(k + 2) % 3])
        e = r0 * u + r1 * v + r2
        f0, f1 = r0 - u * r2, r1 - v * r2
        a0 += e * e * weight
        hx += r0 * e * weight
        hy += r1 * e * weight
        hz += r2 * e * weight
        bxx += r0 * r0 * weight
        bxy += r0 * r1 * weight
        byy += r1 * r1 * weight
        fxx += f0 * f0 * weight_others
        fxy += f0 * f1 * weight_others
        fyy += f1 * f1 * weight_others
        cov_zz += r2 * r2 * variances[k]
    ia = 1.0 / a0
    zz = z * z

    # Gradient on the sums.
    g_u, g_v, g_z = grad[0] * fx, grad[1] * fy, grad[10]
    scale_xx, scale_xy, scale_yy = ia / (fx * fx), ia / (fx * fy), ia / (fy * fy)
    g_fyy = grad[2] * zz * scale_xx
    g_fxy = -2.0 * grad[3] * zz * scale_xy
    g_fxx = grad[4] * zz * scale_yy
    conic = g_fyy * fyy + g_fxy * fxy + g_fxx * fxx
    g_z += 2.0 * conic / z
    g_hx, g_hy, g_hz = grad[5] * ia / fx, grad[6] * ia / fy, 0.0
    g_bxx, g_bxy, g_byy = grad[7] * scale_xx, 2.0 * grad[8] * scale_xy, grad[9] * scale_yy
    quotients = conic + g_hx * hx + g_hy * hy + g_bxx * bxx + g_bxy * bxy + g_byy * byy
    g_a0 = grad[12] - quotients * ia
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    nx, ny, nz = -hx / length, -hy / length, -hz / length
    gx = camera[0] * grad[19] + camera[1] * grad[20] + camera[2] * grad[21]
    gy = camera[3] * grad[19] + camera[4] * grad[20] + camera[5] * grad[21]
    gz = camera[6] * grad[19] + camera[7] * grad[20] + camera[8] * grad[21]
    along = gx * nx + gy * ny + gz * nz
    g_hx -= (gx - along * nx) / length
    g_hy -= (gy - along * ny) / length
    g_hz -= (gz - along * nz) / length
    g_cov_zz = 0.5 * grad[22] / math.sqrt(cov_zz)

    # Down to axes, weights and the ray through the mean.
    grad_logs[0] = grad_logs[1] = grad_logs[2] = 0.0
    for k in range(3):
        r0, r1, r2 = axes[0, k], axes[1, k], axes[2, k]
        weight = 1.0 / variances[k]
        i, j = (k + 1) % 3, (k + 2) % 3
        weight_others = 1.0 / (variances[i] * variances[j])
        e = r0 * u + r1 * v + r2
        f0, f1 = r0 - u * r2, r1 - v * r2
        h_dot = g_hx * r0 + g_hy * r1 + g_hz * r2
        g_e = weight * (h_dot + 2.0 * e * g_a0)
        g_f0 = weight_others * (2.0 * f0 * g_fxx + f1 * g_fxy)
        g_f1 = weight_others * (f0 * g_fxy + 2.0 * f1 * g_fyy)
        grad_axes[0, k] = weight * (e * g_hx + 2.0 * r0 * g_bxx + r1 * g_bxy) + g_f0 + u * g_e
        grad_axes[1, k] = weight * (e * g_hy + r0 * g_bxy + 2.0 * r1 * g_byy) + g_f1 + v * g_e
        grad_axes[2, k] = (
            weight * e * g_hz + g_e - u * g_f0 - v * g_f1 + 2.0 * r2 * variances[k] * g_cov_zz
        )
        g_u += r0 * g_e - r2 * g_f0
        g_v += r1 * g_e - r2 * g_f1
        g_weight = e * (h_dot + e * g_a0) + r0 * (r0 * g_bxx + r1 * g_bxy) + r1 * r1 * g_byy
        g_others = f0 * (f0 * g_fxx + f1 * g_fxy) + f1 * f1 * g_fyy
        grad_logs[k] += 2.0 * (r2 * r2 * variances[k] * g_cov_zz - weight * g_weight)
        grad_logs[i] -= 2.0 * weight_others * g_others
        grad_logs[j] -= 2.0 * weight_others * g_others
    grad_mean[0] = g_u / z
    grad_mean[1] = g_v / z
    grad_mean[2] = g_z - (g_u * u + g_v * v) / z


@kernel(fast=False)
def backward_range(
    begin: int,
    end: int,
    ids: np.ndarray,
    compact: bool,
    means: np.ndarray,
    log_scales: np.ndarray,
    quats: np.ndarray,
    opacity_logits: np.ndarray,
    sh: np.ndarray,
    orientation: np.ndarray,
    filter_3d: np.ndarray,
    degree: int,
    camera: np.ndarray,
    visible: np.ndarray,
    grad_params: np.ndarray,
    grad_means: np.ndarray,
    grad_log_scales: np.ndarray,
    grad_quats: np.ndarray,
    grad_opacity_logits: np.ndarray,
    grad_sh: np.ndarray,
    grad_orientation: np.ndarray,
) -> None:
    """Write the gradients of the Gaussians ``begin .. end``, or of ``ids[begin .. end]``.

    Those that are not visible have none. With ``compact`` row k of the ``grad_`` arrays is
    overwritten with the gradient of ``ids[k]``; without, ``ids`` is not read and the gradient of
    Gaussian i is added to row i.
    """
    rotation = np.zeros((3, 3))
    axes = np.zeros((3, 3))
    grad_axes = np.zeros((3, 3))
    grad_rotation = np.zeros((3, 3))
    variances = np.zeros(3)
    kept = np.zeros(3)
    grad = np.zeros(24)
    grad_logs = np.zeros(3)
    grad_local = np.zeros(3)
    grad_quat = np.zeros(4)
    harmonics = np.zeros(16)
    slopes = np.zeros((16, 3))
    for row_out in range(begin, end):
        i = np.int64(row_out)
        if compact:
            i = np.int64(ids[row_out])
            grad_means[row_out] = 0.0
            grad_log_scales[row_out] = 0.0
            grad_quats[row_out] = 0.0
            grad_opacity_logits[row_out] = 0.0
            grad_sh[row_out] = 0.0
            grad_orientation[row_out] = 0.0
        if not visible[i]:
            continue
        for column in range(23):
            grad[column] = grad_params[i, column]

        # The activations of the forward pass again; cheaper than keeping them.
        m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        x = camera[0] * m0 + camera[1] * m1 + camera[2] * m2 + camera[9]
        y = camera[3] * m0 + camera[4] * m1 + camera[5] * m2 + camera[10]
        z = camera[6] * m0 + camera[7] * m1 + camera[8] * m2 + camera[11]
        qw, qx, qy, qz = (
            np.float64(quats[i, 0]),
            np.float64(quats[i, 1]),
            np.float64(quats[i, 2]),
            np.float64(quats[i, 3]),
        )
        norm = rotation_from_quat(qw, qx, qy, qz, rotation)
        for k in range(3):
            for row in range(3):
                axes[row, k] = (
                    camera[3 * row] * rotation[0, k]
                    + camera[3 * row + 1] * rotation[1, k]
                    + camera[3 * row + 2] * rotation[2, k]
                )
        filter_sq = np.float64(filter_3d[i]) * np.float64(filter_3d[i])
        product = 1.0
        for k in range(3):
            raw = math.exp(2.0 * np.float64(log_scales[i, k]))
            variances[k] = raw + filter_sq
            kept[k] = raw / variances[k]
            product *= kept[k]
        sigmoid = 1.0 / (1.0 + math.exp(-np.float64(opacity_logits[i])))
        fade = 1.0 / (1.0 + math.exp(np.float64(opacity_logits[i])))
        opacity = math.sqrt(product) * sigmoid

        _shape_gradient(x, y, z, variances, camera, axes, grad, grad_axes, grad_logs, grad_local)
        g_log_opacity = grad[11] * opacity
        grad_opacity_logits[row_out] += g_log_opacity * fade
        for k in range(3):
            # d(effective log scale) = kept d(log scale); the filter also dims the opacity.
            grad_log_scales[row_out, k] += kept[k] * grad_logs[k] + (1.0 - kept[k]) * g_log_opacity
        if norm > 0.0:
            for row in range(3):
                for k in range(3):
                    grad_rotation[row, k] = (
                        camera[row] * grad_axes[0, k]
                        + camera[3 + row] * grad_axes[1, k]
                        + camera[6 + row] * grad_axes[2, k]
                    )
            _quat_gradient(qw, qx, qy, qz, norm, grad_rotation, grad_quat)
            for k in range(4):
                grad_quats[row_out, k] += grad_quat[k]

        # Colour, through the coefficients and through the viewing direction.
        d0, d1, d2 = m0 - camera[12], m1 - camera[13], m2 - camera[14]
        distance = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        d0, d1, d2 = d0 / distance, d1 / distance, d2 / distance
        count = (degree + 1) * (degree + 1)
        basis(degree, d0, d1, d2, harmonics)
        basis_gradient(degree, d0, d1, d2, slopes)
        g0 = g1 = g2 = 0.0
        for channel in range(3):
            value = 0.5
            for k in range(count):
                value += harmonics[k] * np.float64(sh[i, k, channel])
            if value < 0.0:
                continue
            g = grad[13 + channel]
            for k in range(count):
                coefficient = g * np.float64(sh[i, k, channel])
                grad_sh[row_out, k, channel] += g * harmonics[k]
                g0 += coefficient * slopes[k, 0]
                g1 += coefficient * slopes[k, 1]
                g2 += coefficient * slopes[k, 2]
        along = g0 * d0 + g1 * d1 + g2 * d2
        g0 = (g0 - along * d0) / distance
        g1 = (g1 - along * d1) / distance
        g2 = (g2 - along * d2) / distance
        for column in range(3):
            colour = g0 if column == 0 else (g1 if column == 1 else g2)
            grad_means[row_out, column] += (
                camera[column] * grad_local[0]
                + camera[3 + column] * grad_local[1]
                + camera[6 + column] * grad_local[2]
                + colour
            )

        # Learned normal tanh(s) d / |d|.
        n0, n1, n2 = (
            np.float64(orientation[i, 0]),
            np.float64(orientation[i, 1]),
            np.float64(orientation[i, 2]),
        )
        length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        if length > _DIRECTION_MIN_NORM:
            n0, n1, n2 = n0 / length, n1 / length, n2 / length
            gain = math.tanh(np.float64(orientation[i, 3]))
            along = grad[16] * n0 + grad[17] * n1 + grad[18] * n2
            grad_orientation[row_out, 0] += gain * (grad[16] - along * n0) / length
            grad_orientation[row_out, 1] += gain * (grad[17] - along * n1) / length
            grad_orientation[row_out, 2] += gain * (grad[18] - along * n2) / length
            grad_orientation[row_out, 3] += (1.0 - gain * gain) * along
