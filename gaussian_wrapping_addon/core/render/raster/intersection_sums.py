# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled reduction of per-intersection values of one band to the visible Gaussians."""

from __future__ import annotations

import math

import numpy as np

from ...kernels.compiled import kernel
from ..simd.raster_math import FLOAT32_MAX, ROW_VALUES, ZERO
from .raster_backward import ABS_U, ABS_V


@kernel(fast=False)
def add_intersection_gradients(
    begin: int,
    end: int,
    ids: np.ndarray,
    intersections: np.ndarray,
    intersection_offsets: np.ndarray,
    fresh: bool,
    grad_params: np.ndarray,
) -> None:
    """Add the intersection gradients of the Gaussians ``ids[begin .. end]`` to ``grad_params``.

    With ``fresh`` the rows of ``grad_params (n, 24)`` start at 0, whatever their content. The last
    two columns receive sums of absolute values. Slots are added in order, which is that of tiles.
    """
    total = np.zeros(ROW_VALUES, np.float32)
    for k in range(begin, end):
        i = ids[k]
        if fresh:
            total[:] = ZERO
        else:
            for column in range(ROW_VALUES):
                total[column] = grad_params[i, column]
        for slot in range(intersection_offsets[i], intersection_offsets[i + 1]):
            for column in range(ROW_VALUES):
                total[column] += intersections[slot, column]
        for column in range(ROW_VALUES):
            grad_params[i, column] = total[column]


@kernel(fast=False)
def write_screen_gradients(
    begin: int,
    end: int,
    ids: np.ndarray,
    grad_params: np.ndarray,
    grad_px: np.ndarray,
    grad_abs_px: np.ndarray,
) -> None:
    """Write the norms of the gradient on (u, v) and of its sum of absolute values.

    The columns of the absolute values are then set to 0, as params have none there, and so are rows
    that overflow float32.
    """
    for k in range(begin, end):
        i = ids[k]
        row = grad_params[i]
        size = np.float64(0.0)
        for column in range(ROW_VALUES):
            size += abs(np.float64(row[column]))
        if not size <= FLOAT32_MAX:
            row[:] = ZERO
        # In float64: squares of float32 overflow beyond 1e19.
        u, v = np.float64(row[0]), np.float64(row[1])
        grad_px[i] = math.sqrt(u * u + v * v)
        u, v = np.float64(row[ABS_U]), np.float64(row[ABS_V])
        grad_abs_px[i] = math.sqrt(u * u + v * v)
        row[ABS_U] = row[ABS_V] = ZERO


@kernel(fast=False)
def add_intersection_weights(
    begin: int,
    end: int,
    ids: np.ndarray,
    intersection_weights: np.ndarray,
    intersection_offsets: np.ndarray,
    weight_sum: np.ndarray,
    weight_max: np.ndarray,
) -> None:
    """Reduce the blending weights of the Gaussians ``ids[begin .. end]`` over intersections."""
    for k in range(begin, end):
        i = ids[k]
        total, largest = weight_sum[i], weight_max[i]
        for slot in range(intersection_offsets[i], intersection_offsets[i + 1]):
            total += intersection_weights[slot, 0]
            largest = max(largest, intersection_weights[slot, 1])
        weight_sum[i], weight_max[i] = total, largest


@kernel(fast=False)
def mark_visible(
    begin: int,
    end: int,
    ids: np.ndarray,
    boxes: np.ndarray,
    visible: np.ndarray,
    radii_px: np.ndarray,
) -> None:
    """Mark the Gaussians ``ids[begin .. end]`` visible; write half their boxes' longer side."""
    for k in range(begin, end):
        i = ids[k]
        visible[i] = True
        width, height = boxes[i, 2] - boxes[i, 0], boxes[i, 3] - boxes[i, 1]
        radii_px[i] = np.float32(0.5) * max(width, height)
