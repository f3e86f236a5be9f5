# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled kernels of the multi-view terms: reprojection between two views, patch comparison."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .. import limits
from ..compiled import inline, kernel

# Cameras are (6,): fx, fy, cx, cy, width, height.

HALF_PATCH = limits.HALF_PATCH
PATCH_STEP_PX = limits.PATCH_STEP_PX
SAMPLES = (2 * HALF_PATCH + 1) ** 2
MAX_NOISE_PX, MIN_NOISE_PX = limits.MAX_NOISE_PX, limits.MIN_NOISE_PX
SPREAD_PRODUCT = limits.SPREAD_PRODUCT
MAX_ERROR = limits.MAX_PATCH_ERROR
MIN_NORMAL, MIN_FACING = limits.MIN_PLANE_NORMAL, limits.MIN_PLANE_FACING
SKIPPED, KEPT = limits.PATCH_SKIPPED, limits.PATCH_KEPT
BROKEN = limits.PATCH_BROKEN


@inline
def _on_image(x: Any, y: Any, camera: Any) -> Any:
    return x >= 0.0 and y >= 0.0 and x <= camera[4] and y <= camera[5]


@inline
def _masked(mask: Any, x: Any, y: Any) -> Any:
    """Whether the pixel at an image position is masked."""
    return (
        mask.shape[0] > 0
        and not mask[min(int(y), mask.shape[0] - 1), min(int(x), mask.shape[1] - 1)]
    )


@kernel(fast=False, fused=True)
def lift_range(
    begin: int, end: int, pixels: np.ndarray, depth: np.ndarray, camera: np.ndarray,
    other: np.ndarray, pose: np.ndarray, near_z: float, other_mask: np.ndarray,
    positions: np.ndarray, position_slopes: np.ndarray,
) -> None:  # fmt: skip
    """Project pixels into the other view, with derivatives by their depth.

    Parameters
    ----------
    pixels : (m,) int32
        ``row * width + column``.
    depth : (h, w) float32
    camera, other : (6,) float64
    pose : (3, 4) float64
        Other camera from reference camera.
    positions : (m, 2) float32
        Written: pixels of the other view; NaN behind ``near_z``, outside the image or masked.
    position_slopes : (m, 2) float64
        Written: derivative with respect to the depth.
    """
    width = depth.shape[1]
    for k in range(begin, end):
        row, column = pixels[k] // width, pixels[k] % width
        z = float(depth[row, column])
        x = (column + 0.5 - camera[2]) / camera[0]
        y = (row + 0.5 - camera[3]) / camera[1]
        a0 = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]
        a1 = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]
        a2 = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]
        h2 = a2 * z + pose[2, 3]
        positions[k, 0] = positions[k, 1] = np.float32(math.nan)
        position_slopes[k, 0] = position_slopes[k, 1] = 0.0
        if not h2 > near_z:
            continue
        u, v = (a0 * z + pose[0, 3]) / h2, (a1 * z + pose[1, 3]) / h2
        at_x, at_y = other[0] * u + other[2], other[1] * v + other[3]
        if not _on_image(at_x, at_y, other) or _masked(other_mask, at_x, at_y):
            continue
        positions[k, 0], positions[k, 1] = np.float32(at_x), np.float32(at_y)
        position_slopes[k, 0] = other[0] * (a0 - u * a2) / h2
        position_slopes[k, 1] = other[1] * (a1 - v * a2) / h2


@kernel(fast=False, fused=True)
def return_range(
    begin: int, end: int, pixels: np.ndarray, width: int, positions: np.ndarray, found: np.ndarray,
    camera: np.ndarray, other: np.ndarray, pose: np.ndarray, near_z: float, noise: np.ndarray,
    by_found: np.ndarray, by_positions: np.ndarray,
) -> None:  # fmt: skip
    """Compute the reprojection error of pixels (the noise), with derivatives.

    Parameters
    ----------
    positions : (m, 2) float32
        Positions in the other view.
    found : (m,) float32
        Depth of the other view there; 0 where undefined.
    noise : (m,) float64
        Written: pixels; inf where undefined or not below :data:`MAX_NOISE_PX`.
    by_found : (m,), by_positions : (m, 2) float64
        Written: derivative of the noise; 0 where it is inf or nearly 0.
    """
    for k in range(begin, end):
        noise[k] = math.inf
        by_found[k] = by_positions[k, 0] = by_positions[k, 1] = 0.0
        z = float(found[k])
        if not z > near_z:
            continue
        x = (float(positions[k, 0]) - other[2]) / other[0]
        y = (float(positions[k, 1]) - other[3]) / other[1]
        c0, c1, c2 = x * z - pose[0, 3], y * z - pose[1, 3], z - pose[2, 3]
        b0 = pose[0, 0] * c0 + pose[1, 0] * c1 + pose[2, 0] * c2
        b1 = pose[0, 1] * c0 + pose[1, 1] * c1 + pose[2, 1] * c2
        b2 = pose[0, 2] * c0 + pose[1, 2] * c1 + pose[2, 2] * c2
        if not b2 > near_z:
            continue
        row, column = pixels[k] // width, pixels[k] % width
        at_x = camera[0] * b0 / b2 + camera[2]
        at_y = camera[1] * b1 / b2 + camera[3]
        off_x, off_y = at_x - (column + 0.5), at_y - (row + 0.5)
        length = math.sqrt(off_x * off_x + off_y * off_y)
        if not (length < MAX_NOISE_PX and _on_image(at_x, at_y, camera)):
            continue
        noise[k] = length
        if length < MIN_NOISE_PX:
            continue
        g0, g1 = camera[0] * off_x / (length * b2), camera[1] * off_y / (length * b2)
        g2 = -(g0 * b0 + g1 * b1) / b2
        # In the other camera's frame.
        e0 = pose[0, 0] * g0 + pose[0, 1] * g1 + pose[0, 2] * g2
        e1 = pose[1, 0] * g0 + pose[1, 1] * g1 + pose[1, 2] * g2
        e2 = pose[2, 0] * g0 + pose[2, 1] * g1 + pose[2, 2] * g2
        by_found[k] = e0 * x + e1 * y + e2
        by_positions[k, 0], by_positions[k, 1] = e0 * z / other[0], e1 * z / other[1]


@inline
def _corner(grey: Any, x: Any, y: Any) -> Any:
    """Upper left of the four pixels around a position, and the right and lower weights."""
    at_x, at_y = x - 0.5, y - 0.5
    column = min(max(int(at_x), 0), grey.shape[1] - 2)
    row = min(max(int(at_y), 0), grey.shape[0] - 2)
    return row, column, at_x - column, at_y - row


@inline
def _between(grey: Any, x: Any, y: Any) -> Any:
    """Whether a position lies between pixel centres; false for NaN."""
    return x >= 0.5 and y >= 0.5 and x <= grey.shape[1] - 0.5 and y <= grey.shape[0] - 0.5


@inline
def _all_count(mask: Any, row: Any, column: Any) -> Any:
    """Whether a pixel and those to its right and below are unmasked."""
    return mask.shape[0] == 0 or (
        mask[row, column]
        and mask[row, column + 1]
        and mask[row + 1, column]
        and mask[row + 1, column + 1]
    )


@kernel(fast=False, fused=True)
def compare_range(  # type: ignore[no-untyped-def]
    begin, end, pixels, noise, depth, normals, alpha, rotation, camera, other, pose, near_z,
    grey, other_grey, mask, other_mask, squared, sizes, max_rise, min_spread, states, errors,
    by_depth, by_normals,
):  # fmt: skip
    """Compare patches around pixels with the other photo, warped by their planes.

    Parameters
    ----------
    pixels : (m,) int32, noise : (m,) float64
        Pixels whose noise is inf are skipped.
    depth, alpha : (h, w) float32, normals : (h, w, 3) float32
        Images of the reference view; blended normals, scene frame.
    rotation : (3, 3) float64
        Reference camera from scene.
    grey, other_grey : (h, w) float32, mask, other_mask : bool or (0, 0) for none
    squared : bool
        Correlation -1 is as good as 1.
    sizes : int
        Number of patch sizes, each twice the one before, tried until a patch is not flat.
    max_rise : float
        Largest deviation of the surface from the plane within a patch, in half sides of the patch.
    min_spread : float
        Smallest sum of squared deviations of the grey of a patch.
    states : (m,) uint8
        Written: :data:`KEPT` for compared patches, :data:`BROKEN` for non-finite values.
    errors : (m,) float64
        Written: ``1 - correlation``; 0 if not kept, as are the derivatives.
    by_depth : (m,), by_normals : (m, 3) float64
        Written: derivatives with respect to the depth and the normal (scene frame, any length).
    """
    width = depth.shape[1]
    ours, theirs = np.empty(SAMPLES), np.empty(SAMPLES)
    slopes, ratios = np.empty(SAMPLES), np.empty(SAMPLES)
    for k in range(begin, end):
        states[k] = SKIPPED
        errors[k] = by_depth[k] = by_normals[k, 0] = by_normals[k, 1] = by_normals[k, 2] = 0.0
        if not noise[k] < math.inf:
            continue
        row, column = pixels[k] // width, pixels[k] % width
        s0, s1, s2 = normals[row, column, 0], normals[row, column, 1], normals[row, column, 2]
        z, cover = float(depth[row, column]), float(alpha[row, column])
        length = math.sqrt(float(s0) * s0 + float(s1) * s1 + float(s2) * s2)
        if not (length >= MIN_NORMAL * cover and length > 0.0):
            continue
        n0 = (rotation[0, 0] * s0 + rotation[0, 1] * s1 + rotation[0, 2] * s2) / length
        n1 = (rotation[1, 0] * s0 + rotation[1, 1] * s1 + rotation[1, 2] * s2) / length
        n2 = (rotation[2, 0] * s0 + rotation[2, 1] * s1 + rotation[2, 2] * s2) / length
        px, py = (column + 0.5 - camera[2]) / camera[0], (row + 0.5 - camera[3]) / camera[1]
        facing = n0 * px + n1 * py + n2  # n . r_p
        if not abs(facing) >= MIN_FACING * math.sqrt(px * px + py * py + 1.0):
            continue
        step_px, flat = 0.5 * PATCH_STEP_PX, True
        rise = max_rise * HALF_PATCH / camera[0]
        our_spread, their_spread, common = 0.0, 0.0, 0.0
        for _ in range(sizes):
            step_px *= 2.0
            whole, sample = True, 0
            our_sum, their_sum = 0.0, 0.0
            for i in range(-HALF_PATCH, HALF_PATCH + 1):
                for j in range(-HALF_PATCH, HALF_PATCH + 1):
                    at_x, at_y = column + 0.5 + step_px * j, row + 0.5 + step_px * i
                    if not _between(grey, at_x, at_y):
                        whole = False
                        break
                    top, left, right, low = _corner(grey, at_x, at_y)
                    if not _all_count(mask, top, left):
                        whole = False
                        break
                    high = grey[top, left] + right * (grey[top, left + 1] - grey[top, left])
                    below = grey[top + 1, left] + right * (
                        grey[top + 1, left + 1] - grey[top + 1, left]
                    )
                    ours[sample] = high + low * (below - high)
                    x, y = (at_x - camera[2]) / camera[0], (at_y - camera[3]) / camera[1]
                    ratio = (n0 * x + n1 * y + n2) / (facing * z)
                    h0 = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] + ratio * pose[0, 3]
                    h1 = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] + ratio * pose[1, 3]
                    h2 = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] + ratio * pose[2, 3]
                    # The point of the plane has depth 1 / ratio in the reference.
                    if not (ratio > 0.0 and h2 > near_z * ratio):
                        whole = False
                        break
                    if i % HALF_PATCH == 0 and j % HALF_PATCH == 0 and (i != 0 or j != 0):
                        there = float(depth[int(at_y), int(at_x)])
                        if not abs(there * ratio - 1.0) < rise * step_px:
                            whole = False
                            break
                    u, v = h0 / h2, h1 / h2
                    to_x, to_y = other[0] * u + other[2], other[1] * v + other[3]
                    if not _between(other_grey, to_x, to_y):
                        whole = False
                        break
                    top, left, right, low = _corner(other_grey, to_x, to_y)
                    if not _all_count(other_mask, top, left):
                        whole = False
                        break
                    g00, g01 = float(other_grey[top, left]), float(other_grey[top, left + 1])
                    g10, g11 = (
                        float(other_grey[top + 1, left]),
                        float(other_grey[top + 1, left + 1]),
                    )
                    high, below = g00 + right * (g01 - g00), g10 + right * (g11 - g10)
                    theirs[sample] = high + low * (below - high)
                    across = (g01 - g00) + low * ((g11 - g10) - (g01 - g00))
                    # Derivative of the sample by the ratio.
                    slopes[sample] = (
                        across * other[0] * (pose[0, 3] - u * pose[2, 3])
                        + (below - high) * other[1] * (pose[1, 3] - v * pose[2, 3])
                    ) / h2
                    ratios[sample] = ratio
                    our_sum += ours[sample]
                    their_sum += theirs[sample]
                    sample += 1
                if not whole:
                    break
            if not whole:
                break
            our_mean, their_mean = our_sum / SAMPLES, their_sum / SAMPLES
            our_spread = their_spread = common = 0.0
            for sample in range(SAMPLES):
                a, b = ours[sample] - our_mean, theirs[sample] - their_mean
                our_spread += a * a
                their_spread += b * b
                common += a * b
            flat = not (our_spread > min_spread and their_spread > min_spread)
            if not flat:
                break
        if flat:
            continue
        product = our_spread * their_spread + SPREAD_PRODUCT
        root = math.sqrt(product)
        correlation = common / root
        agreement = correlation * correlation if squared else correlation
        error = min(max(1.0 - agreement, 0.0), 2.0)
        if not math.isfinite(error):
            states[k] = BROKEN
            continue
        if not error < MAX_ERROR:
            continue
        chain = -2.0 * correlation if squared else -1.0
        pull = common * our_spread / product
        of_depth, d0, d1, d2 = 0.0, 0.0, 0.0, 0.0
        sample = 0
        for i in range(-HALF_PATCH, HALF_PATCH + 1):
            for j in range(-HALF_PATCH, HALF_PATCH + 1):
                a, b = ours[sample] - our_mean, theirs[sample] - their_mean
                by_ratio = chain * (a - pull * b) / root * slopes[sample]
                share = ratios[sample] * z
                of_depth -= by_ratio * ratios[sample]
                x = px + step_px * j / camera[0]
                y = py + step_px * i / camera[1]
                d0 += by_ratio * (x - share * px)
                d1 += by_ratio * (y - share * py)
                d2 += by_ratio * (1.0 - share)
                sample += 1
        inverse = 1.0 / (facing * z * length)
        of_depth, d0, d1, d2 = of_depth / z, d0 * inverse, d1 * inverse, d2 * inverse
        if not math.isfinite(of_depth + d0 + d1 + d2):
            states[k] = BROKEN
            continue
        states[k] = KEPT
        errors[k] = error
        by_depth[k] = of_depth
        for c in range(3):
            by_normals[k, c] = rotation[0, c] * d0 + rotation[1, c] * d1 + rotation[2, c] * d2
