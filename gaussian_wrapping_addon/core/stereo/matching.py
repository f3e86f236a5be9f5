# SPDX-License-Identifier: GPL-3.0-or-later
"""PatchMatch: matching cost of slanted windows, propagation, source views, consistency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import ndimage

from .. import limits
from ..compiled import kernel, part
from ..resampling import LUMA
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

LEAST_LEVEL = 16.0
"""Darker pixels tell no gain."""

LEAST_TOLERANCE_LEVELS = 2.0
TOLERANCE_PER_SPREAD = 3.0
"""Difference in grey levels that is as bad as any larger one: so many times the median difference
of agreeing pixels, and at least that."""

LEAST_PAIRS = 50
"""Agreeing pixels of two photos below which their brightness is not compared."""

MOST_PAIRS = 20_000
"""Pixels of a photo that are looked at, at most."""

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
    means: np.ndarray,
    inverse_depths: np.ndarray,
    confirmed: np.ndarray,
    maps: np.ndarray,
    other_means: list[np.ndarray],
) -> np.ndarray:
    """Return (s, 2) float32: gain and rate of each source of a photo.

    A window on a smooth plain surface shows a ramp of shading, and a ramp correlates with itself at
    any shift. How bright it is does tell the shift, as far as light and exposure are the same.

    Parameters
    ----------
    means : (h, w) float32
        Mean grey level around each pixel.
    inverse_depths : (h, w) float32
        Where ``confirmed`` is not 0.
    confirmed : (h, w) uint8
        Bits of the sources whose own depth agrees.
    maps : (s, 12) float32
        From the photo to its sources (:mod:`~.matching`).
    other_means : list of (h', w') float32
        As ``means``, of the sources.
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


# -- Which photos each photo is matched with (docs/method.md, section 11.5) -----------------------


MOST_SOURCES = 8
"""Sources of a photo; one bit each in a byte. With five, a fifth fewer background pixels are
confirmed."""

BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG = 12.0, 5.0, 12.0
"""Angle between two rays to a point at which matching is best, and how fast it gets worse."""

LEAST_GAIN = 1e-3
"""Least share of the points for which a source is of use."""

_MOST_POINTS = 1500
"""Points that decide, subsampled from those given."""


def source_views(cameras: Sequence[Camera], points: np.ndarray) -> list[np.ndarray]:
    """Choose the sources of each photo, greedily, best first.

    A point in both images counts by the angle between its two rays and by the likeness of its two
    scales, the less the more sources chosen before hold it.

    Parameters
    ----------
    cameras : sequence of Camera
    points : (n, 3) float64
        Sparse points in the frame of the cameras.

    Returns
    -------
    list of (k,) int64
        Indices of at most :data:`MOST_SOURCES` other cameras, for each camera; empty where none
        shares points with it.
    """
    count = len(cameras)
    points = points[:: max(1, -(-len(points) // _MOST_POINTS))]
    if len(points) == 0:
        return [np.zeros(0, np.int64) for _ in cameras]
    inside = np.zeros((count, len(points)), bool)
    scale = np.ones((count, len(points)))  # scene units per pixel
    for i, camera in enumerate(cameras):
        inside[i], depth = in_image(camera, points)
        scale[i] = np.maximum(depth, limits.NEAR_Z) / camera.fx
    centers = np.stack([camera.center for camera in cameras])  # (c, 3)
    rays = points[None] - centers[:, None]  # (c, n, 3)
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    return [_sources_of(i, inside, scale, rays) for i in range(count)]


def in_image(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tell which points (n, 3) project into the image, and return their z-depths (n,)."""
    pixels, depth = camera.project(points)
    size = np.array([camera.width, camera.height])
    return (depth > limits.NEAR_Z) & (pixels >= 0).all(1) & (pixels < size).all(1), depth


def _sources_of(view: int, inside: np.ndarray, scale: np.ndarray, rays: np.ndarray) -> np.ndarray:
    seen = np.flatnonzero(inside[view])
    both = inside[:, seen]  # (c, m)
    cosine = np.einsum("pi,cpi->cp", rays[view, seen], rays[:, seen])
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    width_deg = np.where(angle_deg < BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG)
    likeness = np.minimum(scale[view, seen] / scale[:, seen], scale[:, seen] / scale[view, seen])
    gain = both * likeness * np.exp(-0.5 * ((angle_deg - BEST_ANGLE_DEG) / width_deg) ** 2)
    gain[view] = 0.0
    covered = np.zeros(len(seen))
    chosen: list[int] = []
    for _ in range(min(MOST_SOURCES, len(inside) - 1)):
        score = (gain / (1.0 + covered)).sum(1)
        score[chosen] = 0.0
        best = int(score.argmax())
        if score[best] <= LEAST_GAIN * max(1, len(seen)):
            break
        chosen.append(best)
        covered += gain[best]
    return np.array(chosen, np.int64)


# -- One sweep of PatchMatch over a photo: planes spread between pixels and are refined -----------
#
# See docs/method.md, section 11.3.


KEPT_SOURCES = 2
"""Sources in which a pixel is judged: its best ones. The others may not see its surface."""

REFINEMENTS = 2
"""Random changes tried per pixel and sweep, the second half as large as the first."""

LEAST_COSINE = F32(0.12)
"""Between ray and normal, 83 degrees: more grazing planes are not tried."""

GOOD_COST = F32(0.3)
"""A pixel that costs less in the sources it kept is not judged in the others."""

RANDOM_ABOVE = F32(0.5)
"""A random plane is tried where the cost is at least this."""

SAME_SHARE = F32(0.001)
"""Planes nearer than this share of the depth over the whole window are the same: under 0.1 px."""

NEAR_VARIANCE_PX = 25.0
ALIKE_LEVELS = 12.0
"""Widths of the two factors of a sample's weight: distance from the centre, difference in grey."""

NORMAL_SPREAD = F32(20)
"""Relative change of the normal per relative change of the depth, at most 1."""

PRIOR_STRENGTH, PRIOR_TEXTURE, PRIOR_SHARE = F32(0.25), F32(20), F32(0.01)
"""Largest cost of leaving the prior's plane; variance of grey at which half of it is left; share of
the depth that counts as leaving it."""


@part(fast=True)
def _prior_cost(
    prior: Any, row: Any, column: Any, w: Any, a: Any, b: Any, lens: Any, variance: Any
) -> Any:
    """Return the cost of leaving the prior's plane, which fades where there is texture."""
    if prior.shape[0] == 0:
        return ZERO
    there = prior[row, column, 0]
    if there <= ZERO:
        return ZERO
    away = (w - there) / (PRIOR_SHARE * there)
    slope_x = (a - prior[row, column, 1]) * lens[0] / there
    slope_y = (b - prior[row, column, 2]) * lens[1] / there
    like = np.exp(-HALF * away * away - TWO * (slope_x * slope_x + slope_y * slope_y))
    return PRIOR_STRENGTH * PRIOR_TEXTURE / (PRIOR_TEXTURE + variance) * (ONE - like)


@part(fast=True)
def _cost_in(
    sources: Any, kept: Any, bound: Any, costs: Any, u: Any, v: Any, w: Any, a: Any, b: Any,
    maps: Any, back_maps: Any, quads: Any, sizes: Any, bases: Any, stride: Any, brightness: Any,
    inverse_depths: Any, geometric: Any, table: Any, found: Any, mean: Any, variance: Any,
) -> Any:  # fmt: skip
    """Return the mean cost in a set of sources (bits), or ``bound`` once it cannot be less."""
    total, limit = ZERO, bound * F32(kept)
    for s in range(maps.shape[0]):
        if (sources >> s) & 1:
            costs[s] = view_cost(
                s, u, v, w, a, b, maps, back_maps, quads, sizes, bases, stride, brightness,
                inverse_depths, geometric, table, found, mean, variance,
            )  # fmt: skip
            total += costs[s]
            if total >= limit:
                return bound
    return total / F32(kept)


@kernel(fast=True)
def sweep(
    grey: np.ndarray, order: np.ndarray, neighbours: np.ndarray, fresh: bool,
    planes: np.ndarray, cost: np.ndarray, best_sources: np.ndarray, variances: np.ndarray,
    maps: np.ndarray, back_maps: np.ndarray, quads: np.ndarray, sizes: np.ndarray,
    bases: np.ndarray, stride: float, brightness: np.ndarray, inverse_depths: np.ndarray,
    geometric: float, lens: np.ndarray, depth_range: np.ndarray, span: float, prior: np.ndarray,
    seed: int,
) -> None:  # fmt: skip
    """Visit the pixels of a photo once and give each the best plane found.

    The present plane is judged in the sources that the pixel kept, and where it costs
    :data:`GOOD_COST` or more there, in all; the best few are kept. A neighbour's plane
    is judged in the sources that the neighbour kept: the pixel's own may be those where the surface
    is hidden. A winner with other sources is judged in all of them again.

    Parameters
    ----------
    grey : (h, w) uint8
    order : (h * w,) int64
        Pixels in the order of the visit.
    neighbours : (k, 2) int64
        Offsets (x, y) from which planes are taken over.
    fresh : bool
        Whether planes are still random: a random one is tried everywhere, and the neighbours' sets
        of sources say nothing yet.
    planes : (h, w, 3) float32
        Changed: w, a, b of each pixel.
    cost, variances : (h, w) float32
        Written: mean cost in the two best sources, brightness left out, and weighted variance of
        the window.
    best_sources : (h, w) uint8
        Changed: bits of the sources kept.
    maps, back_maps : (s, 12) float32
        From this photo to its sources and back.
    quads, sizes, bases, stride
        Of the sources (:func:`~.matching.window_cost`); ``sizes`` is (s, 2) float32, last
        column and row.
    brightness : (s, 2) float32
        Of the sources (:func:`~.matching.brightness_of`).
    inverse_depths : (photos * height * stride,) float32
        Present depths of all photos; not read where ``geometric`` is 0.
    geometric : float32
        Cost of a pixel of forward-backward error.
    lens : (4,) float32
    depth_range : (2,) float32
        Least and largest inverse depth.
    span : float32
        Relative change of the depth in the first refinement.
    prior : (h, w, 3) float32
        Planes that hold where there is no texture, w 0 where there is none; or (0, 0, 3).
    seed : uint32
    """
    width, height = grey.shape[1], grey.shape[0]
    count = maps.shape[0]
    kept = min(KEPT_SOURCES, count)
    least_w, most_w = depth_range[0], depth_range[1]
    has_prior = prior.shape[0] > 0
    state = np.array([seed], np.uint32)
    table, found = np.empty((6, SAMPLES), np.float32), np.empty(SAMPLES, np.int32)
    near, alike = np.empty(SAMPLES, np.float32), np.empty(256, np.float32)
    costs, trial = np.empty(count, np.float32), np.empty(count, np.float32)
    not_compared = np.zeros((count, 2), np.float32)
    for i in range(SAMPLES):
        table[AT_X, i], table[AT_Y, i] = F32(WINDOW[i, 0]), F32(WINDOW[i, 1])
        distance_sq = table[AT_X, i] * table[AT_X, i] + table[AT_Y, i] * table[AT_Y, i]
        near[i] = np.exp(-distance_sq / F32(2.0 * NEAR_VARIANCE_PX))
    for i in range(256):
        alike[i] = np.exp(-F32(i) / F32(ALIKE_LEVELS))
    for visit in range(len(order)):
        row, column = order[visit] // width, order[visit] % width
        u, v = F32(column), F32(row)
        mean, variance = fill_window(grey, row, column, near, alike, table)
        w, a, b = planes[row, column, 0], planes[row, column, 1], planes[row, column, 2]
        best, chosen, judge = ZERO, 0, True
        for step in range(len(neighbours) + REFINEMENTS + 2):
            if judge:
                known = 0 if fresh or step > 0 else int(best_sources[row, column])
                total = ZERO
                for s in range(count):
                    costs[s] = WORST_COST
                for others in range(2):
                    if others == 1 and known != 0 and total < GOOD_COST * F32(kept):
                        break
                    for s in range(count):
                        if (known >> s) & 1 != others:
                            costs[s] = view_cost(
                                s, u, v, w, a, b, maps, back_maps, quads, sizes, bases, stride,
                                brightness, inverse_depths, geometric, table, found, mean,
                                variance,
                            )  # fmt: skip
                            total += costs[s]
                chosen, total = 0, ZERO
                for _ in range(kept):
                    least = -1
                    for s in range(count):
                        if not (chosen >> s) & 1 and (least < 0 or costs[s] < costs[least]):
                            least = s
                    chosen |= 1 << least
                    total += costs[least]
                best = total / F32(kept)
                best += _prior_cost(prior, row, column, w, a, b, lens, variance)
                judge = False
            sources = chosen
            if step < len(neighbours):
                x, y = column + neighbours[step, 0], row + neighbours[step, 1]
                if x < 0 or y < 0 or x >= width or y >= height:
                    continue
                new_a, new_b = planes[y, x, 1], planes[y, x, 2]
                new_w = planes[y, x, 0] + new_a * F32(column - x) + new_b * F32(row - y)
                tilt = REACH_PX * max(abs(new_a - a), abs(new_b - b))
                if max(abs(new_w - w), tilt) < SAME_SHARE * w:
                    continue
                if not fresh:
                    sources = int(best_sources[y, x])
            elif step == len(neighbours):
                if not has_prior or prior[row, column, 0] <= ZERO:
                    continue
                new_w = prior[row, column, 0]
                new_a, new_b = prior[row, column, 1], prior[row, column, 2]
            elif step <= len(neighbours) + REFINEMENTS:
                reach = span * HALF ** F32(step - len(neighbours) - 1)
                nx, ny, nz, _ = normal_of(u, v, w, a, b, lens)
                new_w = w * (ONE + reach * (TWO * random_share(state) - ONE))
                turn = min(reach * NORMAL_SPREAD, ONE)
                nx += turn * (random_share(state) - HALF)
                ny += turn * (random_share(state) - HALF)
                nz += turn * (random_share(state) - HALF)
                new_a, new_b = slopes_of(u, v, new_w, nx, ny, nz, lens)
            else:
                if not fresh and best < RANDOM_ABOVE:
                    continue
                new_w = least_w + (most_w - least_w) * random_share(state)
                nx, ny = TWO * random_share(state) - ONE, TWO * random_share(state) - ONE
                new_a, new_b = slopes_of(u, v, new_w, nx, ny, ONE, lens)
            if not (new_w >= least_w and new_w <= most_w):
                continue
            if normal_of(u, v, new_w, new_a, new_b, lens)[3] < LEAST_COSINE:
                continue
            extra = _prior_cost(prior, row, column, new_w, new_a, new_b, lens, variance)
            if extra >= best:
                continue
            value = extra + _cost_in(
                sources, kept, best - extra, trial, u, v, new_w, new_a, new_b, maps, back_maps,
                quads, sizes, bases, stride, brightness, inverse_depths, geometric, table, found,
                mean, variance,
            )  # fmt: skip
            if value < best:
                w, a, b, best = new_w, new_a, new_b, value
                judge = sources != chosen
                for s in range(count):
                    if (chosen >> s) & 1 and not judge:
                        costs[s] = trial[s]
        planes[row, column, 0], planes[row, column, 1], planes[row, column, 2] = w, a, b
        # What others read of the cost is how well the windows match, however bright they are.
        total = WORST_COST * F32(KEPT_SOURCES - kept)
        for s in range(count):
            if (chosen >> s) & 1:
                total += view_cost(
                    s, u, v, w, a, b, maps, back_maps, quads, sizes, bases, stride, not_compared,
                    inverse_depths, geometric, table, found, mean, variance,
                )  # fmt: skip
        cost[row, column] = total / F32(KEPT_SOURCES)
        best_sources[row, column] = np.uint8(chosen)
        variances[row, column] = variance


# -- All photos at one level of the pyramid, packed for the kernels, and their planes -------------


_NEAREST = ((-1, 0), (0, -1), (1, 0), (0, 1))
_FAR_PX = (3, 5, 9, 7)
"""Distance of the two farther neighbours, in turn from sweep to sweep."""

_FIRST_SPAN, _LATER_SPAN = 0.1, 0.02
"""Relative change of the depth by the first refinement, while planes are random and later."""

_MEAN_PX = 5
"""Side of the window over which grey levels are averaged to compare the brightness of photos."""

_MOST_SEED = 2**32 - 1
"""Seeds of a sweep lie between 1 and this: the generator would stay at 0."""

NO_PRIOR = np.zeros((0, 0, 3), np.float32)
NO_DEPTHS = np.zeros(1, np.float32)


def grey_levels(photo: np.ndarray) -> np.ndarray:
    """Return a photo (h, w, 3) uint8 as (h, w) uint8 grey levels."""
    return np.asarray(photo @ np.array(LUMA) + 0.5, np.uint8)


class MatchingLevel:
    """Planes of all photos at one size.

    Parameters
    ----------
    cameras : sequence of Camera
        Of the photos at this size.
    greys : sequence of (h, w) uint8
    sources : sequence of (k,) int64
        Sources of each photo.
    depth_ranges : (n, 2) float32
        Least and largest inverse depth of each photo.

    Attributes
    ----------
    planes : (n, h, w, 3) float32
        Hypotheses; photos smaller than the largest fill the upper left corner.
    costs, variances : list of (h, w) float32
    confirmed : list of (h, w) uint8
        Bits of the sources that agree, after :meth:`confirm`.
    brightness : list of (k, 2) float32
        Gain and rate of the sources of each photo (:func:`~.matching.brightness_of`), after
        :meth:`compare_brightness`; until then it is not compared.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        greys: Sequence[np.ndarray],
        sources: Sequence[np.ndarray],
        depth_ranges: np.ndarray,
    ) -> None:
        self.cameras, self.greys, self.sources = list(cameras), list(greys), list(sources)
        self.depth_ranges = depth_ranges.astype(np.float32)
        count = len(self.greys)
        height, width = (max(grey.shape[k] for grey in self.greys) for k in (0, 1))
        quads = np.zeros((count, height, width), np.uint32)
        for quad, grey in zip(quads, self.greys, strict=True):
            wide = np.pad(grey, ((0, 1), (0, 1)), "edge").astype(np.uint32)
            right, below = wide[:-1, 1:] << 8, wide[1:, :-1] << 16
            quad[: grey.shape[0], : grey.shape[1]] = (
                wide[:-1, :-1] | right | below | wide[1:, 1:] << 24
            )
        self._quads, self._stride = quads.reshape(-1).view(np.int32), np.float32(width)
        self._photo_pixels = height * width
        self.planes = np.zeros((count, height, width, 3), np.float32)
        # A photo without sources is never swept: nothing matches there.
        self.costs = [np.full(grey.shape, WORST_COST, np.float32) for grey in self.greys]
        self.variances = [np.zeros(grey.shape, np.float32) for grey in self.greys]
        self._best_sources, self.confirmed = (
            [np.zeros(grey.shape, np.uint8) for grey in self.greys] for _ in range(2)
        )
        self.brightness = [np.tile(NO_BRIGHTNESS, (len(chosen), 1)) for chosen in self.sources]
        self.lenses = [_lens(camera) for camera in self.cameras]
        self._joined = [self._join(view) for view in range(count)]

    def __len__(self) -> int:
        return len(self.greys)

    def planes_of(self, view: int) -> np.ndarray:
        """Return the (h, w, 3) planes of a photo; a view of :attr:`planes`."""
        height, width = self.greys[view].shape
        return self.planes[view, :height, :width]

    def inverse_depths(self) -> np.ndarray:
        """Return a copy of all inverse depths, flat, as kernels read them."""
        return np.ascontiguousarray(self.planes[..., 0]).reshape(-1)

    def sweep(
        self,
        view: int,
        turn: int,
        seed: int,
        *,
        fresh: bool = False,
        geometric: float = 0.0,
        inverse_depths: np.ndarray = NO_DEPTHS,
        prior: np.ndarray = NO_PRIOR,
    ) -> None:
        """Run one sweep over a photo.

        Parameters
        ----------
        turn : int
            Number of the sweep: it decides direction and farther neighbours.
        seed : int
        fresh, geometric, inverse_depths, prior
            As in :func:`~.matching.sweep`.
        """
        if len(self.sources[view]) == 0:
            return
        maps, back_maps, sizes, bases = self._joined[view]
        order, neighbours = _visit(self.greys[view].shape, turn)
        planes = np.ascontiguousarray(self.planes_of(view))
        sweep(
            self.greys[view], order, neighbours, fresh, planes, self.costs[view],
            self._best_sources[view], self.variances[view], maps, back_maps, self._quads, sizes,
            bases, self._stride, self.brightness[view], inverse_depths, np.float32(geometric),
            self.lenses[view], self.depth_ranges[view],
            np.float32(_FIRST_SPAN if fresh else _LATER_SPAN), prior,
            np.uint32(1 + (7919 * (view + 1) + 104729 * turn + 31 * seed) % _MOST_SEED),
        )  # fmt: skip
        self.planes_of(view)[:] = planes

    def confirm(self, view: int, inverse_depths: np.ndarray) -> np.ndarray:
        """Find the sources that agree; return the mean inverse depth over them, (h, w)."""
        shape = self.greys[view].shape
        means = np.zeros(shape, np.float32)
        if len(self.sources[view]):
            maps, back_maps, sizes, bases = self._joined[view]
            confirm(
                np.ascontiguousarray(self.planes_of(view)), maps, back_maps, inverse_depths,
                self.planes.reshape(-1, 3), sizes, bases, self._stride, self.confirmed[view],
                means,
            )  # fmt: skip
        return means

    def compare_brightness(self) -> None:
        """Measure gains between photos on the confirmed pixels; costs compare them from now on."""
        means = [
            ndimage.uniform_filter(grey.astype(np.float32), _MEAN_PX, mode="nearest")
            for grey in self.greys
        ]
        for view, chosen in enumerate(self.sources):
            self.brightness[view] = brightness_of(
                means[view], self.planes_of(view)[..., 0], self.confirmed[view],
                self._joined[view][0], [means[source] for source in chosen],
            )  # fmt: skip

    def start_from(self, coarse: MatchingLevel, view: int) -> None:
        """Take over planes and brightness of a level of half the size."""
        height, width = self.greys[view].shape
        last_row, last_column = (n - 1 for n in coarse.greys[view].shape)
        row, column = np.mgrid[:height, :width]
        above = np.minimum(row // 2, last_row), np.minimum(column // 2, last_column)
        planes = coarse.planes_of(view)[above]  # (h, w, 3)
        planes[..., 0] += planes[..., 1] * (0.5 * column - 0.25 - above[1])
        planes[..., 0] += planes[..., 2] * (0.5 * row - 0.25 - above[0])
        planes[..., 0] = planes[..., 0].clip(*self.depth_ranges[view])
        planes[..., 1:] *= 0.5
        self.planes_of(view)[:] = planes
        self._best_sources[view][:] = coarse._best_sources[view][above]
        self.costs[view][:] = coarse.costs[view][above]
        self.confirmed[view][:] = coarse.confirmed[view][above]
        self.brightness[view] = coarse.brightness[view]

    def _join(self, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return maps to the sources and back (s, 12), their sizes (s, 2) and first pixels (s,)."""
        maps, back_maps, sizes = [], [], []
        for source in self.sources[view]:
            here, there = self.cameras[view], self.cameras[source]
            rotation = there.rotation @ here.rotation.T
            offset = there.cam_from_world[:, 3] - rotation @ here.cam_from_world[:, 3]
            lens_here, lens_there = _matrix(here), _matrix(there)
            maps.append(_map(lens_there, rotation, offset, lens_here))
            back_maps.append(_map(lens_here, rotation.T, -rotation.T @ offset, lens_there))
            sizes.append((there.width - 1, there.height - 1))
        bases = np.asarray(self.sources[view], np.uint64) * np.uint64(self._photo_pixels)
        return (
            np.array(maps, np.float32).reshape(-1, 12),
            np.array(back_maps, np.float32).reshape(-1, 12),
            np.array(sizes, np.float32).reshape(-1, 2),
            bases,
        )


def _matrix(camera: Camera) -> np.ndarray:
    """(3, 3) pixels from camera coordinates; centres of pixels at whole numbers."""
    return np.array(
        [[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]]
    )


def _lens(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5], np.float32)


def _map(
    lens_there: np.ndarray, rotation: np.ndarray, offset: np.ndarray, lens_here: np.ndarray
) -> np.ndarray:
    """(12,) of :mod:`~.matching`: a homography, and what depth adds."""
    homography = lens_there @ rotation @ np.linalg.inv(lens_here)
    return np.concatenate([homography.reshape(-1), lens_there @ offset])


def _visit(shape: tuple[int, ...], turn: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the order of the pixels, forwards and backwards in turn, and the neighbours."""
    order = np.arange(shape[0] * shape[1], dtype=np.int64)
    far = _FAR_PX[turn % len(_FAR_PX)]
    neighbours = np.array([*_NEAREST, (-far, 0), (0, -far)], np.int64)
    return (np.ascontiguousarray(order[::-1]) if turn % 2 else order), neighbours
