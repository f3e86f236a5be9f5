# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled rows of the structural similarity (SSIM) of two images, and its gradient."""

from __future__ import annotations

import numpy as np

from ..compiled import kernel

WINDOW = 11
"""Side of the Gaussian window, pixels; sigma is 1.5 (method.md 3.1)."""
RADIUS = WINDOW // 2
SIGMA_PX = 1.5

_taps = [np.exp(-0.5 * ((i - RADIUS) / SIGMA_PX) ** 2) for i in range(WINDOW)]
WEIGHTS = tuple(float(tap / sum(_taps)) for tap in _taps)

C1 = 0.01**2
C2 = 0.03**2

_W0, _W1, _W2, _W3, _W4, _W5 = WEIGHTS[: RADIUS + 1]


@kernel(fast=True)
def _filter_row(source, count, out):  # type: ignore[no-untyped-def]
    """out[j] = sum_k weight[k] source[j + 3 k]: along a row of interleaved colours."""
    kind = out.dtype.type
    w0, w1, w2, w3, w4, w5 = kind(_W0), kind(_W1), kind(_W2), kind(_W3), kind(_W4), kind(_W5)
    a, b = source[0:count], source[30 : 30 + count]
    c, d = source[3 : 3 + count], source[27 : 27 + count]
    e, f = source[6 : 6 + count], source[24 : 24 + count]
    g, h = source[9 : 9 + count], source[21 : 21 + count]
    i, k = source[12 : 12 + count], source[18 : 18 + count]
    m = source[15 : 15 + count]
    for j in range(count):
        out[j] = (
            w0 * (a[j] + b[j])
            + w1 * (c[j] + d[j])
            + w2 * (e[j] + f[j])
            + w3 * (g[j] + h[j])
            + w4 * (i[j] + k[j])
            + w5 * m[j]
        )


@kernel(fast=True)
def _filter_column(rows, first, count, out):  # type: ignore[no-untyped-def]
    """out[j] = sum_k weight[k] rows[first + k, j]."""
    kind = out.dtype.type
    w0, w1, w2, w3, w4, w5 = kind(_W0), kind(_W1), kind(_W2), kind(_W3), kind(_W4), kind(_W5)
    a, b = rows[first], rows[first + 10]
    c, d = rows[first + 1], rows[first + 9]
    e, f = rows[first + 2], rows[first + 8]
    g, h = rows[first + 3], rows[first + 7]
    i, k = rows[first + 4], rows[first + 6]
    m = rows[first + 5]
    for j in range(count):
        out[j] = (
            w0 * (a[j] + b[j])
            + w1 * (c[j] + d[j])
            + w2 * (e[j] + f[j])
            + w3 * (g[j] + h[j])
            + w4 * (i[j] + k[j])
            + w5 * m[j]
        )


@kernel(fast=True)
def _products(x, y, count, xx, yy, xy):  # type: ignore[no-untyped-def]
    for j in range(count):
        xx[j] = x[j] * x[j]
        yy[j] = y[j] * y[j]
        xy[j] = x[j] * y[j]


@kernel(fast=True)
def _similarity_row(mu_x, mu_y, xx, yy, xy, count, value, by_mean, by_square, by_product):  # type: ignore[no-untyped-def]
    """SSIM of one row of windows, and its derivatives with respect to E[x], E[x^2], E[x y]."""
    kind = value.dtype.type
    c1, c2, two = kind(C1), kind(C2), kind(2.0)
    for j in range(count):
        mx, my = mu_x[j], mu_y[j]
        a1 = two * mx * my + c1
        a2 = two * (xy[j] - mx * my) + c2
        b1 = mx * mx + my * my + c1
        b2 = (xx[j] - mx * mx) + (yy[j] - my * my) + c2
        scale = kind(1.0) / (b1 * b2)
        s = a1 * a2 * scale
        value[j] = s
        by_mean[j] = two * (my * (a2 - a1) * scale - s * mx * (b2 - b1) * scale)
        by_square[j] = -s * b1 * scale
        by_product[j] = two * a1 * scale


@kernel(fast=True)
def similarity_rows(begin, end, image, photo, mask, sums, counts, maps):  # type: ignore[no-untyped-def]
    """SSIM of the rows of windows [begin, end).

    Parameters
    ----------
    image, photo : (h, 3 w) float
        Interleaved colours in [0, 1].
    mask : (h, w) bool, or (0, 0) for none
        Windows whose centre is false are left out.
    sums : (h - 10,) float64, counts : (h - 10,) int64
        Sum of SSIM over the values of each row of windows, and how many.
    maps : (3, h - 10, 3 w - 30) float, or (3, 0, 0) to skip them
        Derivatives of the sum with respect to E[x], E[x^2] and E[x y] of each window.
    """
    width = image.shape[1]
    count = width - 30
    rows = end - begin + 10
    filtered = np.empty((5, rows, count), image.dtype)
    xx = np.empty(width, image.dtype)
    yy = np.empty(width, image.dtype)
    xy = np.empty(width, image.dtype)
    for r in range(rows):
        x, y = image[begin + r], photo[begin + r]
        _products(x, y, width, xx, yy, xy)
        _filter_row(x, count, filtered[0, r])
        _filter_row(y, count, filtered[1, r])
        _filter_row(xx, count, filtered[2, r])
        _filter_row(yy, count, filtered[3, r])
        _filter_row(xy, count, filtered[4, r])
    means = np.empty((5, count), image.dtype)
    value = np.empty(count, image.dtype)
    partial = np.empty((3, count), image.dtype)
    for r in range(end - begin):
        for q in range(5):
            _filter_column(filtered[q], r, count, means[q])
        _similarity_row(
            means[0], means[1], means[2], means[3], means[4], count, value,
            partial[0], partial[1], partial[2],
        )  # fmt: skip
        row = begin + r
        used = 0
        total = 0.0
        if mask.shape[0] > 0:
            for p in range(count // 3):
                keep = mask[row + 5, p + 5]
                used += 3 if keep else 0
                for channel in range(3):
                    if keep:
                        total += value[3 * p + channel]
                    else:
                        partial[0, 3 * p + channel] = 0.0
                        partial[1, 3 * p + channel] = 0.0
                        partial[2, 3 * p + channel] = 0.0
        else:
            used = count
            for j in range(count):
                total += value[j]
        sums[row] = total
        counts[row] = used
        if maps.shape[1] > 0:
            for q in range(3):
                for j in range(count):
                    maps[q, row, j] = partial[q, j]


@kernel(fast=True)
def similarity_gradient_rows(begin, end, image, photo, maps, factor, gradient):  # type: ignore[no-untyped-def]
    """Add ``factor`` x the gradient of the summed SSIM to rows [begin, end) of ``gradient``."""
    height, width = image.shape
    count = width - 30
    out_rows = height - 10
    rows = end - begin
    columns = np.zeros((3, rows, width + 30), image.dtype)
    kind = image.dtype.type
    for r in range(rows):
        row = begin + r
        low, high = max(0, row - 10), min(out_rows, row + 1)
        for q in range(3):
            target = columns[q, r, 30 : 30 + count]
            for source in range(low, high):
                weight = kind(WEIGHTS[row - source])
                line = maps[q, source]
                for j in range(count):
                    target[j] += weight * line[j]
    spread = np.empty((3, width), image.dtype)
    scale, two = kind(factor), kind(2.0)
    for r in range(rows):
        for q in range(3):
            _filter_row(columns[q, r], width, spread[q])
        x, y, out = image[begin + r], photo[begin + r], gradient[begin + r]
        by_mean, by_square, by_product = spread[0], spread[1], spread[2]
        for j in range(width):
            out[j] += scale * (by_mean[j] + two * x[j] * by_square[j] + y[j] * by_product[j])
