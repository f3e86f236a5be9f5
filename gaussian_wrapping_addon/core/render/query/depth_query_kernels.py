# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled query at positions of a view: the depth of the isosurface."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...kernels.compiled import inline, kernel
from ..simd.raster_math import (
    ALPHA_MAX,
    ALPHA_MIN,
    DENOMINATOR_MIN,
    HALF,
    ISO_LEVEL,
    ONE,
    TRANSMITTANCE_MIN,
    TWO,
    ZERO,
    exp_short,
)
from ..simd.vector_runs import lowest_bit, positive_run
from .query_spans import (
    A0,
    OPACITY,
    PX,
    PY,
    QA,
    QB,
    QC,
    RUN,
    SPAN,
    TILE_COLUMNS,
    R,
    S,
    T,
    U,
    V,
    Z,
    fill_cell,
    fill_tile,
    longest_list,
)
from .ray_solver import NEGLIGIBLE, TINY, solve_ray, transmittance_at

# Columns of a span after those of the Gaussians: their values on the ray of the current position.
_RAW, _PEAK, _SHARPNESS = 13 * SPAN, 14 * SPAN, 15 * SPAN
_COLUMNS = 16


@inline
def _evaluate_span(span: Any, x: Any, y: Any) -> None:
    """Evaluate a span on the ray of a position; opacity 0 where it is below 1/255."""
    for j in range(SPAN):
        dx = x - span[U + j]
        dy = y - span[V + j]
        shift = dx * span[PX + j] + dy * span[PY + j]
        num = max((dx * span[QA + j] + dy * span[QB + j]) * dx + dy * dy * span[QC + j], ZERO)
        den = dx * dx * span[R + j] + dx * dy * span[S + j] + dy * dy * span[T + j]
        den = max(den + TWO * shift + ONE, DENOMINATOR_MIN)
        inverse = ONE / den
        raw = exp_short(HALF * num * inverse) * span[OPACITY + j]
        span[_RAW + j] = raw if raw >= ALPHA_MIN else ZERO
        span[_PEAK + j] = (shift + ONE) * inverse * span[Z + j]
        span[_SHARPNESS + j] = span[A0 + j] * den


@kernel(fast=True)
def query_range(
    first_tile: int,
    end_tile: int,
    params: np.ndarray,
    boxes: np.ndarray,
    skews: np.ndarray,
    start: np.ndarray,
    gaussian_ids: np.ndarray,
    tiles_x: int,
    shift: int,
    cell_start: np.ndarray,
    coordinates: np.ndarray,
    limit: float,
    values: np.ndarray,
    slopes: np.ndarray,
    stops: np.ndarray,
) -> None:
    """Write the depth of the isosurface and the slope of ``-log T`` at the positions of tiles.

    ``values (k,)`` are 0 where there is no depth. ``stops (k,) int32`` receives the number of
    Gaussians of the cell's list up to the one that makes the ray opaque.
    """
    longest = longest_list(first_tile, end_tile, start, shift, cell_start)
    room = (longest + SPAN - 1) // SPAN
    tile_spans = np.empty((room, TILE_COLUMNS * SPAN), np.float32)
    spans = np.empty((room, _COLUMNS * SPAN), np.float32)
    nearest_depths = np.empty(room + 1, np.float32)
    members = np.empty(longest, np.int64)
    alphas = np.empty(room * SPAN, np.float32)
    peaks = np.empty(room * SPAN, np.float32)
    sharpnesses = np.empty(room * SPAN, np.float32)
    filled = -1
    for cell in range(first_tile << (2 * shift), end_tile << (2 * shift)):
        if cell_start[cell] == cell_start[cell + 1]:
            continue
        tile = cell >> (2 * shift)
        if tile != filled:
            fill_tile(
                tile, tiles_x, params, boxes, skews, start, gaussian_ids, tile_spans
            )  # fmt: skip
            filled = tile
        total = fill_cell(
            _COLUMNS, cell & ((1 << (2 * shift)) - 1), shift,
            start[tile + 1] - start[tile], tile_spans, spans, nearest_depths, members,
        )  # fmt: skip
        for p in range(cell_start[cell], cell_start[cell + 1]):
            x, y = coordinates[p, 0], coordinates[p, 1]
            transmittance, high = ONE, ZERO
            before_crossing, crossing = ZERO, 0
            count: Any = 0
            stop: Any = total
            for at in range((total + SPAN - 1) // SPAN):
                if (
                    transmittance <= limit
                    and transmittance < ISO_LEVEL
                    and nearest_depths[at] >= high
                ):
                    break
                span = spans[at]
                _evaluate_span(span, x, y)
                saturated = False
                for run in range(0, SPAN, RUN):
                    hits = positive_run(RUN, span, _RAW + run)
                    while hits != np.uint64(0):
                        j = run + np.int64(lowest_bit(hits))
                        hits &= hits - np.uint64(1)
                        raw, peak = span[_RAW + j], span[_PEAK + j]
                        alphas[count] = raw
                        peaks[count] = peak
                        sharpnesses[count] = span[_SHARPNESS + j]
                        before = transmittance
                        transmittance -= min(raw, ALPHA_MAX) * transmittance
                        if before > ISO_LEVEL:
                            high = max(high, peak)
                            if transmittance <= ISO_LEVEL:
                                before_crossing, crossing = before, count
                        count += 1
                        if transmittance < TRANSMITTANCE_MIN:
                            stop = at * SPAN + j + 1
                            saturated = True
                            break
                    if saturated:
                        break
                if saturated:
                    break
            stops[p] = stop
            values[p], slopes[p] = ZERO, ONE
            if not (
                before_crossing > ZERO and transmittance <= limit and transmittance < ISO_LEVEL
            ):
                continue
            sharpest = ZERO
            kept = 0
            for c in range(count):
                sharpness, peak = sharpnesses[c], peaks[c]
                beyond = max(peak - high, ZERO)
                matters = sharpness * beyond * beyond < NEGLIGIBLE
                if c == crossing:
                    crossing = kept
                alphas[kept] = alphas[c]
                peaks[kept] = peak
                sharpnesses[kept] = sharpness
                if matters:
                    sharpest = max(sharpest, sharpness)
                    kept += 1
            if nearest_depths[0] <= ZERO:
                # Some Gaussian may reach the camera: a crossing needs T > 0.5 at depth 0.
                product = transmittance_at(kept, ZERO, alphas, peaks, sharpnesses)
                if product <= ISO_LEVEL:
                    continue
            # The Gaussian at the crossing alone reaches T = 0.5 where its fall-off is ratio.
            weight = min(alphas[crossing], ALPHA_MAX) * before_crossing
            ratio = min(max((before_crossing - ISO_LEVEL) / max(weight, TINY), ZERO), ONE)
            log_ratio = math.log(max(ratio, TINY))
            ahead = math.sqrt(max(-TWO * log_ratio / max(sharpnesses[crossing], TINY), ZERO))
            guess = peaks[crossing] - ahead
            if not (guess > ZERO and guess < high):
                guess = HALF * high
            values[p], slopes[p] = solve_ray(
                kept, alphas, peaks, sharpnesses, high, guess,
                math.sqrt(max(sharpest, TINY)), math.sqrt(max(sharpnesses[crossing], TINY)),
            )  # fmt: skip
