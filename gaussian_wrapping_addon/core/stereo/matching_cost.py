# SPDX-License-Identifier: GPL-3.0-or-later
"""Cost of a plane hypothesis in another photo: one minus a weighted correlation of two windows.

See docs/method.md, section 11.2.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..kernels.compiled import part
from .consistency import GAIN, RATE
from .plane_kernels import F32, NEAREST_Z, ONE, ZERO, back_error_px

WORST_COST = F32(1.2)
"""Of a window that leaves the other photo; no cost is larger. Uncapped, one view in which the
surface is hidden would outweigh several that show it."""

NOISE_VARIANCE = F32(4.0)
"""Added to both variances, squared grey levels: windows without texture cost about 1 for all
planes, so that others decide there."""

SHADING_COST, SHADING_TEXTURE = F32(1.0), F32(40)
"""Cost of a window that is clearly brighter or darker than the other photo's; variance of grey at
which half of it is left."""

_OFFSETS = range(-5, 6, 2)
WINDOW = np.array(
    [(x, y) for y in _OFFSETS for x in _OFFSETS if abs(x) + abs(y) < 10], np.int64
)  # (32, 2)
"""Samples of a window, pixels: every second one of 11 x 11 without the corners. 32 are four vectors
of eight lanes."""
SAMPLES = len(WINDOW)
REACH_PX = F32(5)

# Rows of the table of a reference window, (6, SAMPLES) float32.
AT_X, AT_Y, WEIGHT, WEIGHTED_GREY, SHARE_X, SHARE_Y = range(6)

_BYTE = np.int32(255)


@part(fast=True)
def window_cost(
    quads: Any, base: Any, stride: Any, width: Any, height: Any, x: Any, y: Any,
    xu: Any, xv: Any, yu: Any, yv: Any, gain: Any, rate: Any, table: Any, found: Any, mean: Any,
    variance: Any,
) -> Any:  # fmt: skip
    """Return the cost of the reference window in another photo, affinely warped.

    ``1 - correlation`` of both windows, and where there is little texture the difference of their
    mean levels.

    Three loops, because LLVM vectorises the first and the last and leaves only the loads scalar:
    2.4 times as fast as one loop.

    Parameters
    ----------
    quads : (photos * height * stride,) int32
        Four grey levels of a pixel and its neighbours right and below, one byte each: one load per
        sample.
    base : uint64
        Index of the photo's first pixel.
    width, height : float32
        Last column and row of the photo.
    x, y : float32
        Where the window's centre lands.
    xu, xv, yu, yv : float32
        Derivatives of that place by the pixel of the reference.
    gain, rate : float32
        Brightness of the other photo (:func:`~.consistency.brightness_of`).
    table : (6, SAMPLES) float32
        The reference window; the last two rows are scratch.
    found : (SAMPLES,) int32
        Scratch.
    mean, variance : float32
        Weighted, of the reference window.
    """
    reach_x = REACH_PX * (abs(xu) + abs(xv))
    reach_y = REACH_PX * (abs(yu) + abs(yv))
    inside = x >= reach_x and y >= reach_y and x + reach_x < width and y + reach_y < height
    if not inside:
        return WORST_COST
    for i in range(SAMPLES):
        px = x + xu * table[AT_X, i] + xv * table[AT_Y, i]
        py = y + yu * table[AT_X, i] + yv * table[AT_Y, i]
        column, row = F32(np.int32(px)), F32(np.int32(py))
        table[SHARE_X, i], table[SHARE_Y, i] = px - column, py - row
        found[i] = np.int32(row * stride + column)  # exact below 2^24 pixels
    for i in range(SAMPLES):
        found[i] = quads[base + np.uint64(np.uint32(found[i]))]
    total, total_sq, product = ZERO, ZERO, ZERO
    for i in range(SAMPLES):
        quad, share_x, share_y = found[i], table[SHARE_X, i], table[SHARE_Y, i]
        g00 = F32(np.int32(quad & _BYTE))
        g01 = F32(np.int32((quad >> np.int32(8)) & _BYTE))
        g10 = F32(np.int32((quad >> np.int32(16)) & _BYTE))
        g11 = F32(np.int32((quad >> np.int32(24)) & _BYTE))
        top = g00 + share_x * (g01 - g00)
        grey = top + share_y * (g10 + share_x * (g11 - g10) - top) - mean
        weighted = table[WEIGHT, i] * grey
        total += weighted
        total_sq += weighted * grey
        product += table[WEIGHTED_GREY, i] * grey
    other = max(total_sq - total * total, ZERO)
    spread = np.sqrt((variance + NOISE_VARIANCE) * (other + NOISE_VARIANCE))
    cost = ONE - product / spread
    brighter = abs(gain * (total + mean) - mean) * rate
    cost += SHADING_COST * SHADING_TEXTURE / (SHADING_TEXTURE + variance) * min(brighter, ONE)
    return min(cost, WORST_COST)


@part(fast=True)
def view_cost(
    s: Any, u: Any, v: Any, w: Any, a: Any, b: Any, maps: Any, back_maps: Any, quads: Any,
    sizes: Any, bases: Any, stride: Any, brightness: Any, inverse_depths: Any, geometric: Any,
    table: Any, found: Any, mean: Any, variance: Any,
) -> Any:  # fmt: skip
    """Return the cost of plane (w, a, b) of pixel (u, v) in source ``s``.

    Where ``geometric`` is not 0, that many times the forward-backward error in pixels is added.
    """
    m = maps[s]
    z = m[6] * u + m[7] * v + m[8] + w * m[11]
    if z <= NEAREST_Z:
        return WORST_COST
    r = ONE / z
    x = (m[0] * u + m[1] * v + m[2] + w * m[9]) * r
    y = (m[3] * u + m[4] * v + m[5] + w * m[10]) * r
    zu, zv = m[6] + a * m[11], m[7] + b * m[11]
    cost = window_cost(
        quads, bases[s], stride, sizes[s, 0], sizes[s, 1], x, y,
        r * (m[0] + a * m[9] - x * zu), r * (m[1] + b * m[9] - x * zv),
        r * (m[3] + a * m[10] - y * zu), r * (m[4] + b * m[10] - y * zv),
        brightness[s, GAIN], brightness[s, RATE], table, found, mean, variance,
    )  # fmt: skip
    if geometric > ZERO and cost < WORST_COST:
        cost += geometric * back_error_px(
            s, u, v, x, y, back_maps, inverse_depths, bases[s], stride
        )
    return cost


@part(fast=True)
def fill_window(grey: Any, row: Any, column: Any, near: Any, alike: Any, table: Any) -> Any:
    """Fill the table of the window around a pixel; return its weighted mean and variance.

    Parameters
    ----------
    grey : (h, w) uint8
    near : (SAMPLES,) float32
        Weight by the distance from the centre.
    alike : (256,) float32
        Weight by the difference of grey levels: samples across an edge count less.
    """
    last_row, last_column = grey.shape[0] - 1, grey.shape[1] - 1
    here = np.int32(grey[row, column])
    total, mean, variance = ZERO, ZERO, ZERO
    for i in range(SAMPLES):
        y = min(max(row + WINDOW[i, 1], 0), last_row)
        x = min(max(column + WINDOW[i, 0], 0), last_column)
        level = np.int32(grey[y, x])
        weight = near[i] * alike[abs(level - here)]
        table[WEIGHT, i], table[WEIGHTED_GREY, i] = weight, F32(level)
        total += weight
        mean += weight * F32(level)
    mean /= total
    for i in range(SAMPLES):
        weight, difference = table[WEIGHT, i] / total, table[WEIGHTED_GREY, i] - mean
        table[WEIGHT, i], table[WEIGHTED_GREY, i] = weight, weight * difference
        variance += weight * difference * difference
    return mean, variance
