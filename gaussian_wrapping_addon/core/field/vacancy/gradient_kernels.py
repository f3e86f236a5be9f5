# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled kernel of the gradient of log transmittance, in float64 and scene coordinates."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

from ...kernels.compiled import kernel

TABLE_COLUMNS = 14
"""Columns of a Gaussian: mean, L = S^-1 R^T by rows, log opacity, and the largest squared
Mahalanobis distance from a ray at which it contributes."""

LOG_HALF = -0.6931471805599453


@kernel(fast=False)
def log_transmittance_gradient(
    begin, end, rows, points, camera, center, tile_px, tiles_x, tiles_y, bounds, row_table,
    tile_start, tile_ids, ids, table, log_t, gradient,
):  # fmt: skip
    """Write log T from one camera and its gradient for ``rows[begin:end]`` of ``points``.

    ``row_table`` are the packed rows of :class:`.camera_bins.CameraBins`, ``ids`` the Gaussian of
    each; ``table (n, 14)`` as above. With s = L (x - o), m = L (mu - o) and the foot k = m.s / s.s,
    q = |m - min(k, 1) s|^2; its derivative by k is 0 where k < 1, so that in both cases
    ``dq/dx = -2 min(k, 1) L^T (m - min(k, 1) s)``.
    """
    for step in range(begin, end):
        p = rows[step]
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        w = camera[6] * x + camera[7] * y + camera[8] * z + camera[11]
        log_t[p] = math.nan
        if not w > camera[21]:
            continue
        u = camera[15] * (camera[0] * x + camera[1] * y + camera[2] * z + camera[9]) / w
        v = camera[16] * (camera[3] * x + camera[4] * y + camera[5] * z + camera[10]) / w
        u += camera[17]
        v += camera[18]
        if not (u >= 0.0 and v >= 0.0 and u <= camera[19] and v <= camera[20]):
            continue
        tile = min(int(v / tile_px), tiles_y - 1) * tiles_x + min(int(u / tile_px), tiles_x - 1)
        rx, ry, rz = x - center[0], y - center[1], z - center[2]
        total = gx = gy = gz = 0.0
        for k in range(tile_start[tile], tile_start[tile + 1]):
            row = tile_ids[k]
            if (
                bounds[row, 0] > u
                or bounds[row, 2] < u
                or bounds[row, 1] > v
                or bounds[row, 3] < v
                or row_table[row, 14] > w
            ):
                continue
            i = ids[row]
            # Differences before whitening, where they are exact (docs/method.md, section 5.4).
            mx, my, mz = table[i, 0] - center[0], table[i, 1] - center[1], table[i, 2] - center[2]
            ma = table[i, 3] * mx + table[i, 4] * my + table[i, 5] * mz
            mb = table[i, 6] * mx + table[i, 7] * my + table[i, 8] * mz
            mc = table[i, 9] * mx + table[i, 10] * my + table[i, 11] * mz
            sa = table[i, 3] * rx + table[i, 4] * ry + table[i, 5] * rz
            sb = table[i, 6] * rx + table[i, 7] * ry + table[i, 8] * rz
            sc = table[i, 9] * rx + table[i, 10] * ry + table[i, 11] * rz
            foot = (ma * sa + mb * sb + mc * sc) / max(sa * sa + sb * sb + sc * sc, 1e-300)
            fa, fb, fc = ma - foot * sa, mb - foot * sb, mc - foot * sc
            if fa * fa + fb * fb + fc * fc > table[i, 13]:
                continue
            at = min(foot, 1.0)
            fa, fb, fc = ma - at * sa, mb - at * sb, mc - at * sc
            log_g = table[i, 12] - 0.5 * (fa * fa + fb * fb + fc * fc)
            if log_g < LOG_HALF:
                total += math.log1p(-math.exp(log_g))
            else:
                total += math.log(max(-math.expm1(log_g), 1e-300))
            # The floor avoids 0 * inf at the centre of an opaque Gaussian.
            pull = at / max(math.expm1(-log_g), 1e-300)
            gx -= pull * (table[i, 3] * fa + table[i, 6] * fb + table[i, 9] * fc)
            gy -= pull * (table[i, 4] * fa + table[i, 7] * fb + table[i, 10] * fc)
            gz -= pull * (table[i, 5] * fa + table[i, 8] * fb + table[i, 11] * fc)
        log_t[p] = total
        gradient[p, 0], gradient[p, 1], gradient[p, 2] = gx, gy, gz
