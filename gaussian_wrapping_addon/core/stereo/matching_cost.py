# SPDX-License-Identifier: GPL-3.0-or-later
"""Matching cost: plane hypotheses, sources that confirm a depth, correlation of slanted windows."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

from ..compiled import kernel, part
from ..scene.camera import Camera

# -- Plane hypotheses in compiled code (docs/method.md, section 11.1) -----------------------------
#
# A hypothesis of a pixel is a plane, written as inverse depth, which is affine in the pixel: ``1
# / z(u + du, v + dv) = w + a du + b dv``. Pixels have their centres at whole numbers here.
#
# Two views are joined by the 12 numbers of a row of ``maps``: the point at pixel (u, v) with
# inverse depth w lies at ``M (u, v, 1) + w k`` in homogeneous pixels of the other view, M row by
# row, then k. ``lens`` is (4,): fx, fy, cx, cy.


F32 = np.float32
ZERO, ONE, TWO, HALF = F32(0), F32(1), F32(2), F32(0.5)

NEAREST_Z = F32(1e-6)
"""Least homogeneous depth, relative to that in the first view, in front of the other camera."""
MAX_BACK_ERROR_PX = F32(3)
"""Largest forward-backward error that counts; occluded pixels have larger ones."""


def lens_matrix(camera: Camera) -> np.ndarray:
    """Return the (3, 3) pixels from camera coordinates; centres of pixels at whole numbers."""
    return np.array(
        [[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]]
    )


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


# -- Which sources confirm the depth of a pixel, and how bright they show it ----------------------
#
# See docs/method.md, sections 11.4 and 11.2.


AGREEING_PX = F32(1)
AGREEING_SHARE = F32(0.01)
"""Largest forward-backward error and relative difference in depth of two views that agree."""

LEAST_LEVEL = 16.0  # darker pixels tell no gain
LEAST_TOLERANCE_LEVELS = 2.0
TOLERANCE_PER_SPREAD = 3.0
"""Difference in grey levels that is as bad as any larger one: so many times the median difference
of agreeing pixels, and at least that."""

LEAST_PAIRS = 50  # agreeing pixels of two photos below which their brightness is not compared
MOST_PAIRS = 20_000  # pixels of a photo that are looked at, at most
GAIN, RATE = 0, 1
"""Columns of a brightness: factor of the source's grey levels, and one over the tolerance, 0 where
brightness is not compared."""

NO_BRIGHTNESS = np.array([1.0, 0.0], np.float32)


@kernel(fast=True)
def confirm(
    planes: np.ndarray, maps: np.ndarray, back_maps: np.ndarray, inverse_depths: np.ndarray,
    all_planes: np.ndarray, sizes: np.ndarray, bases: np.ndarray, stride: float,
    sources: np.ndarray, means: np.ndarray,
) -> None:  # fmt: skip
    """Find the sources whose own depth agrees with that of each pixel.

    Parameters
    ----------
    planes : (h, w, 3) float32
    maps, back_maps : (s, 12) float32
    inverse_depths : (p,) float32, all_planes : (p, 3) float32
        Of all pixels of all photos.
    sizes, bases, stride
        Of the sources (:func:`~.matching.sweep`).
    sources : (h, w) uint8
        Written: bits of those that agree.
    means : (h, w) float32
        Written: mean inverse depth over the pixel and those.
    """
    for row in range(planes.shape[0]):
        for column in range(planes.shape[1]):
            u, v, w = F32(column), F32(row), planes[row, column, 0]
            total, count, bits = w, ONE, 0
            for s in range(maps.shape[0]):
                m = maps[s]
                z = m[6] * u + m[7] * v + m[8] + w * m[11]
                if z <= NEAREST_Z:
                    continue
                x = (m[0] * u + m[1] * v + m[2] + w * m[9]) / z
                y = (m[3] * u + m[4] * v + m[5] + w * m[10]) / z
                if x < ZERO or y < ZERO or x >= sizes[s, 0] or y >= sizes[s, 1]:
                    continue
                error_px = back_error_px(s, u, v, x, y, back_maps, inverse_depths, bases[s], stride)
                if error_px > AGREEING_PX:
                    continue
                nearest_x, nearest_y = np.int32(x + HALF), np.int32(y + HALF)
                there = bases[s] + np.uint64(nearest_y * np.int32(stride) + nearest_x)
                other = inverse_depths[there]
                other += all_planes[there, 1] * (x - F32(nearest_x))
                other += all_planes[there, 2] * (y - F32(nearest_y))
                if abs(other * z - w) > AGREEING_SHARE * w:
                    continue
                bits |= 1 << s
                total += other * z
                count += ONE
            sources[row, column] = np.uint8(bits)
            means[row, column] = total / count


def brightness_of(
    means: np.ndarray, inverse_depths: np.ndarray, confirmed: np.ndarray, maps: np.ndarray,
    other_means: list[np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Return (s, 2) float32: gain and rate of each source of a photo.

    A window on a smooth plain surface shows a ramp of shading, and a ramp correlates with itself at
    any shift. How bright it is does tell the shift, as far as light and exposure are the same.

    Parameters
    ----------
    means, other_means : (h, w) float32
        Mean grey level around each pixel of the photo, and of its sources.
    inverse_depths : (h, w) float32
        Where ``confirmed`` is not 0.
    confirmed : (h, w) uint8
        Bits of the sources whose own depth agrees.
    maps : (s, 12) float32
        From the photo to its sources (:mod:`~.matching`).
    """
    found = np.tile(NO_BRIGHTNESS, (len(maps), 1))
    row, column = np.nonzero(confirmed)
    step = max(1, -(-len(row) // MOST_PAIRS))
    row, column = row[::step], column[::step]
    pixels = np.stack([column, row, np.ones_like(row)], 1).astype(np.float64)  # (n, 3)
    inverse = inverse_depths[row, column].astype(np.float64)
    for number, (m, there) in enumerate(zip(maps.astype(np.float64), other_means, strict=True)):
        place = pixels @ m[:9].reshape(3, 3).T + inverse[:, None] * m[9:]  # (n, 3)
        good = ((confirmed[row, column] >> number) & 1 > 0) & (place[:, 2] > NEAREST_Z)
        at = place[good, :2] / place[good, 2:]
        inside = ((at >= 0) & (at <= (there.shape[1] - 1, there.shape[0] - 1))).all(1)
        own = means[row[good][inside], column[good][inside]]
        other = ndimage.map_coordinates(there, at[inside, ::-1].T, order=1)
        bright = (own >= LEAST_LEVEL) & (other >= LEAST_LEVEL)
        own, other = own[bright], other[bright]
        if len(own) < LEAST_PAIRS:
            continue
        gain = np.exp(np.median(np.log(own / other)))
        spread = np.median(np.abs(gain * other - own))
        tolerance = max(LEAST_TOLERANCE_LEVELS, TOLERANCE_PER_SPREAD * spread)
        found[number] = gain, 1.0 / tolerance
    return found


# -- Cost of a plane hypothesis in another photo: one minus a weighted correlation of two windows
#
# See docs/method.md, section 11.2.


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
        Brightness of the other photo (:func:`~.matching.brightness_of`).
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
