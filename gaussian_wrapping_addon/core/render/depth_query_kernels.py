# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled isosurface depth and transmittance at positions of a view, and their gradient.

Vectors run over the Gaussians of a cell, not over positions, so that one position costs no more
than one of many. The Gaussians that reach a cell are laid out in *spans* of 32: 32 values of one
column after those of another, all of a span inside one array at constant offsets, which is what
lets LLVM vectorise (kernels.md 4.4). The contributors of a position are moved together and solved
by Newton steps on ``log T`` inside a bracket (method.md 2.4).
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from .. import tolerances
from ..compiled import inline, kernel, part
from .area_lists import PIXEL_MARGIN, SHARE_MARGIN, TILE
from .raster_math import (
    ALPHA_MAX,
    ALPHA_MIN,
    DENOMINATOR_MIN,
    FAR,
    FRONT_SIGMAS,
    HALF,
    ISO_LEVEL,
    ONE,
    PREFETCH_AHEAD,
    TRANSMITTANCE_MIN,
    TWO,
    WIDE_END,
    ZERO,
    exp_short,
    exp_wide,
)
from .vector_runs import lowest_bit, positive_run, prefetch_row

GEOMETRY = 13
"""Leading columns of params that a ray's transmittance depends on."""

_BOX_END = 0.999e9
"""Projection cuts boxes off at 1e9 pixels."""

_SPAN = 32
_RUN = 16
_INDEX = np.arange(_SPAN, dtype=np.float32)
# Columns of a span: the Gaussians, ...
_U, _V, _QA, _QB, _QC = 0, _SPAN, 2 * _SPAN, 3 * _SPAN, 4 * _SPAN
_PX, _PY, _R, _S, _T = 5 * _SPAN, 6 * _SPAN, 7 * _SPAN, 8 * _SPAN, 9 * _SPAN
_Z, _OPACITY, _A0 = 10 * _SPAN, 11 * _SPAN, 12 * _SPAN
# ... what they are on the ray of the position at hand, ...
_RAW, _PEAK, _SHARPNESS = 13 * _SPAN, 14 * _SPAN, 15 * _SPAN
_FORWARD_COLUMNS = 16
# ... and the gradients on them.
_G = 13 * _SPAN
_GRADIENT_COLUMNS = 2 * GEOMETRY
# Columns of a span of a tile: the Gaussians, where they begin in depth, and their ellipses.
_FRONT, _CENTER_X, _CENTER_Y, _SKEW = 13 * _SPAN, 14 * _SPAN, 15 * _SPAN, 16 * _SPAN
_EXTREME, _INVERSE, _ACROSS, _MARGIN = 17 * _SPAN, 18 * _SPAN, 19 * _SPAN, 20 * _SPAN
_TOUCHED = 21 * _SPAN
_TILE_COLUMNS = 22
_FLOAT_MARGIN = np.float32(4e-6)
"""Several roundings of a float32, in shares of what is rounded."""

# Converged: a step so small beside the thinnest Gaussian's sigma along the ray that log T is its
# Taylor series, to second order, to float32's precision ...
_STEP_SIGMAS = np.float32(5e-4)
# ... or a transmittance equal to 0.5 within its own rounding ...
_LEVEL_MARGIN = np.float32(1.2e-7)
# ... or a bracket of one rounding of the depth. A step below that rounding alone proves nothing:
# a layer may be steep there and yet end before the level is reached.
_BRACKET_SHARE = np.float32(1.25e-7)
_LEAST_SHARE = np.float32(1.25e-7)
"""Steps are at least this share of the depth, so that they can close the bracket."""
_POLISH_SIGMAS = np.float32(3e-3)
"""A last step is taken up to this length. A longer one would leave the place at which the slope is
known, by which gradients at the stored depth are divided; where T is all but flat, its rounding
would lead far astray."""
_LEVEL_FAR, _FLAT = np.float32(0.05), np.float32(0.02)
"""A layer thinner than a rounding of the depth: T jumps over 0.5 from where it is flat. Its
gradient is lost; rather let it be too small than a thousand times too large."""
_LEAST_SLOPE = np.float32(1e-12)
"""Keeps a step finite; it leaves the bracket then."""
# Halley's correction of a Newton step stays within these factors.
_LEAST_BEND, _MOST_BEND = HALF, TWO
_NEWTON_STEPS = 8
"""From here on every second step is a bisection, which bounds the number of steps."""
_MAX_STEPS = 80
SLOPE_FLOOR = np.float32(tolerances.SLOPE_FLOOR)
"""Floor of -d(log T)/dt in shares of the 1/sigma along the ray of the Gaussian at which the
blending crosses 0.5 (method.md 2.5)."""
# exp(-x) is below 3e-7 beyond this x = s d^2.
_NEGLIGIBLE = np.float32(30.0)
_THIRD, _FIFTH = np.float32(1.0 / 3.0), np.float32(0.2)
_TINY = np.float32(1e-30)


@kernel(fast=False)
def shrink_range(
    begin: int,
    end: int,
    scale: float,
    width: int,
    height: int,
    params: np.ndarray,
    boxes: np.ndarray,
    skews: np.ndarray,
    visible: np.ndarray,
) -> None:
    """Turn the rows ``begin .. end`` of a screen ``scale`` times as fine into pixels.

    Rows that the image of ``width`` x ``height`` hides, because float32 could not hold what
    rendering makes of them (docs/architecture.md), are hidden.
    """
    for i in range(begin, end):
        if not visible[i]:
            continue
        # No column but these depends on the size of a pixel.
        u, v = params[i, 0] / scale, params[i, 1] / scale
        reach_x = max(abs(u), abs(width - u)) + TILE
        reach_y = max(abs(v), abs(height - v)) + TILE
        xx, xy, yy = reach_x * reach_x, reach_x * reach_y, reach_y * reach_y
        square = scale * scale
        qa, qb, qc = params[i, 2] * square, params[i, 3] * square, params[i, 4] * square
        px, py = params[i, 5] * scale, params[i, 6] * scale
        r, s, t = params[i, 7] * square, params[i, 8] * square, params[i, 9] * square
        den = 1.0 + 2.0 * (abs(px) * reach_x + abs(py) * reach_y) + r * xx + abs(s) * xy + t * yy
        holds = reach_x <= tolerances.FINITE_OFFSET_PX and reach_y <= tolerances.FINITE_OFFSET_PX
        holds &= qa * xx + abs(qb) * xy + qc * yy <= tolerances.FINITE_NUM
        holds &= den <= tolerances.FINITE_DEN
        holds &= params[i, 12] * den * params[i, 10] <= tolerances.FINITE_PULL
        visible[i] = holds
        if not holds:
            continue
        for column, value in enumerate((u, v, qa, qb, qc, px, py, r, s, t)):
            params[i, column] = value
        skews[i] /= scale
        for column in range(4):
            if abs(boxes[i, column]) > _BOX_END:
                # Cut off, far beyond the image: no longer the box of the ellipse.
                skews[i] = math.inf
            boxes[i, column] /= scale


@part(fast=False)
def fill_tile(
    tile: int,
    tiles_x: int,
    params: np.ndarray,
    boxes: np.ndarray,
    skews: np.ndarray,
    start: np.ndarray,
    gaussian_ids: np.ndarray,
    spans: np.ndarray,
) -> None:
    """Lay out the Gaussians of a tile and their ellipses in ``spans (s, 22 * 32) float32``."""
    left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
    count = start[tile + 1] - start[tile]
    for k in range(count):
        ahead = start[tile] + min(k + PREFETCH_AHEAD, count - 1)
        prefetch_row(params, np.int64(gaussian_ids[ahead]))
        i = gaussian_ids[start[tile] + k]
        span = spans[k // _SPAN]
        lane = k % _SPAN
        for column in range(GEOMETRY):
            span[column * _SPAN + lane] = params[i, column]
        span[_FRONT + lane] = params[i, 10] - FRONT_SIGMAS * params[i, 22]
        half_x = 0.5 * (np.float64(boxes[i, 2]) - np.float64(boxes[i, 0]))
        half_y = 0.5 * (np.float64(boxes[i, 3]) - np.float64(boxes[i, 1]))
        skew = np.float64(skews[i])
        if math.isinf(skew) or not (half_x > 0.0 and half_y > 0.0):
            # No ellipse that could rule a cell out.
            span[_CENTER_X + lane] = span[_CENTER_Y + lane] = span[_SKEW + lane] = ZERO
            span[_EXTREME + lane] = span[_INVERSE + lane] = span[_MARGIN + lane] = ZERO
            span[_ACROSS + lane] = FAR
            continue
        center_x: Any = 0.5 * (np.float64(boxes[i, 2]) + np.float64(boxes[i, 0])) - left
        across: Any = max(half_x * half_x * (1.0 + SHARE_MARGIN) - skew * skew, 0.0)
        span[_CENTER_X + lane] = center_x
        span[_CENTER_Y + lane] = 0.5 * (np.float64(boxes[i, 3]) + np.float64(boxes[i, 1])) - top
        span[_SKEW + lane] = skew
        span[_EXTREME + lane] = skew / half_x
        span[_INVERSE + lane] = 1.0 / half_y
        span[_ACROSS + lane] = math.sqrt(across)
        span[_MARGIN + lane] = PIXEL_MARGIN + _FLOAT_MARGIN * (half_x + abs(center_x))
    for k in range(count, (count + _SPAN - 1) // _SPAN * _SPAN):
        span = spans[k // _SPAN]
        for column in range(_TILE_COLUMNS):
            span[column * _SPAN + k % _SPAN] = ZERO
        span[_FRONT + k % _SPAN] = FAR
        span[_CENTER_X + k % _SPAN] = -FAR


@inline
def _touch(span: Any, x0: Any, y0: Any, x1: Any, y1: Any) -> None:
    """Mark by 1 the ellipses of a span that reach a rectangle, see ``area_lists.strip_span``."""
    for j in range(_SPAN):
        inverse, center_y = span[_INVERSE + j], span[_CENTER_Y + j]
        first = max((y0 - center_y) * inverse - _FLOAT_MARGIN, -ONE)
        last = min((y1 - center_y) * inverse + _FLOAT_MARGIN, ONE)
        extreme, skew, across = span[_EXTREME + j], span[_SKEW + j], span[_ACROSS + j]
        t = min(max(extreme, first), last)
        right = skew * t + across * math.sqrt(max(ONE - t * t, ZERO))
        t = min(max(-extreme, first), last)
        left = skew * t - across * math.sqrt(max(ONE - t * t, ZERO))
        center_x, margin = span[_CENTER_X + j], span[_MARGIN + j]
        touched = (first <= last) & (center_x + right + margin >= x0)
        touched = touched & (center_x + left - margin <= x1)
        span[_TOUCHED + j] = ONE if touched else ZERO


@part(fast=True)
def fill_cell(
    columns: int,
    part: int,
    shift: int,
    count: int,
    tile_spans: np.ndarray,
    spans: np.ndarray,
    fronts: np.ndarray,
    members: np.ndarray,
) -> int:
    """Lay out those Gaussians of a tile that reach one of its cells; return their number.

    Parameters
    ----------
    columns : int
        Columns of ``spans``.
    part : int
        Number of the cell within its tile.
    count : int
        Gaussians of the tile.
    tile_spans : (t, 22 * 32) float32
        From :func:`fill_tile`.
    spans : (s, columns * 32) float32
        The last span is filled up with Gaussians of no opacity.
    fronts : (s + 1,) float32
        Receives the z-depth before which no Gaussian of this span or a later one has a density
        worth counting.
    members : (g,) int64
        Receives the place of each Gaussian in the tile's list.
    """
    cell_px = TILE >> shift
    margin = np.float32(PIXEL_MARGIN)
    x0 = np.float32((part & ((1 << shift) - 1)) * cell_px)
    y0 = np.float32((part >> shift) * cell_px)
    x1, y1 = x0 + np.float32(cell_px), y0 + np.float32(cell_px)
    total: Any = 0
    for at in range((count + _SPAN - 1) // _SPAN):
        source = tile_spans[at]
        if shift > 0:
            _touch(source, x0, y0 - margin, x1, y1 + margin)
        else:
            for lane in range(_SPAN):
                source[_TOUCHED + lane] = ONE if at * _SPAN + lane < count else ZERO
        for run in range(0, _SPAN, _RUN):
            hits = positive_run(_RUN, source, _TOUCHED + run)
            while hits != np.uint64(0):
                j = run + np.int64(lowest_bit(hits))
                hits &= hits - np.uint64(1)
                target = spans[total // _SPAN]
                lane = total % _SPAN
                for column in range(GEOMETRY):
                    target[column * _SPAN + lane] = source[column * _SPAN + j]
                front, to = source[_FRONT + j], total // _SPAN
                fronts[to] = front if lane == 0 else min(fronts[to], front)
                members[total] = at * _SPAN + j
                total += 1
    last = (total + _SPAN - 1) // _SPAN
    for k in range(total, last * _SPAN):
        for column in range(columns):
            spans[last - 1, column * _SPAN + k % _SPAN] = ZERO
    fronts[last] = FAR
    for at in range(last - 1, -1, -1):
        fronts[at] = min(fronts[at], fronts[at + 1])
    return total


@part(fast=False)
def longest_list(
    first_tile: int, end_tile: int, start: np.ndarray, shift: int, cell_start: np.ndarray
) -> int:
    """Return the length of the longest list of those tiles that hold positions."""
    longest = 0
    for tile in range(first_tile, end_tile):
        if cell_start[tile << (2 * shift)] < cell_start[(tile + 1) << (2 * shift)]:
            longest = max(longest, start[tile + 1] - start[tile])
    return longest


@inline
def _cast(span: Any, x: Any, y: Any) -> None:
    """Evaluate a span on the ray of a position; opacity 0 where it is below 1/255."""
    for j in range(_SPAN):
        dx = x - span[_U + j]
        dy = y - span[_V + j]
        shift = dx * span[_PX + j] + dy * span[_PY + j]
        num = max((dx * span[_QA + j] + dy * span[_QB + j]) * dx + dy * dy * span[_QC + j], ZERO)
        den = dx * dx * span[_R + j] + dx * dy * span[_S + j] + dy * dy * span[_T + j]
        den = max(den + TWO * shift + ONE, DENOMINATOR_MIN)
        inverse = ONE / den
        raw = exp_short(HALF * num * inverse) * span[_OPACITY + j]
        span[_RAW + j] = raw if raw >= ALPHA_MIN else ZERO
        span[_PEAK + j] = (shift + ONE) * inverse * span[_Z + j]
        span[_SHARPNESS + j] = span[_A0 + j] * den


@inline
def _evaluate(capped: Any, count: Any, t: Any, alphas: Any, peaks: Any, sharpnesses: Any) -> Any:
    """Return T and -d(log T)/dt at depth t; ``capped``: what is capped at 0.99 has no slope."""
    product, slope = ONE, ZERO
    for c in range(count):
        ahead = max(peaks[c] - t, ZERO)
        pull = sharpnesses[c] * ahead
        raw = alphas[c] * exp_wide(HALF * pull * ahead)
        density = min(raw, ALPHA_MAX)
        keep = ONE - density
        product *= keep
        steep = density * pull / keep
        if capped:
            steep = steep if raw < ALPHA_MAX else ZERO
        slope += steep
    return product, slope


@inline
def _log_twice(value: Any) -> Any:
    """Return log(2 value), exactly near 0.5 and with the right sign and order elsewhere."""
    y = (TWO * value - ONE) / (TWO * value + ONE)
    square = y * y
    return TWO * y * (ONE + square * (_THIRD + square * _FIFTH))


@inline
def _bend(count: Any, t: Any, alphas: Any, peaks: Any, sharpnesses: Any) -> Any:
    """Return T, the slope -d(log T)/dt and its growth with t, at depth t."""
    product, slope, growth = ONE, ZERO, ZERO
    for c in range(count):
        ahead = max(peaks[c] - t, ZERO)
        fall = HALF * sharpnesses[c] * ahead * ahead
        density = min(alphas[c] * exp_wide(fall), ALPHA_MAX)
        # 0 where nothing changes with t; far behind, the square below could overflow.
        sharpness = sharpnesses[c] if ahead > ZERO and fall <= WIDE_END else ZERO
        pull = sharpness * ahead
        keep = ONE - density
        product *= keep
        odds = density / keep
        slope += odds * pull
        growth += odds * (pull * pull / keep - sharpness)
    return product, slope, growth


@inline
def _solve(
    count: Any, alphas: Any, peaks: Any, sharpnesses: Any, high: Any, guess: Any, sharpest: Any,
    alone: Any,
) -> Any:  # fmt: skip
    """Return where T crosses 0.5 between 0 and ``high``, and -d(log T)/dt there, floored."""
    t, low, found_slope = guess, ZERO, ZERO
    for number in range(_MAX_STEPS):
        product, slope, growth = _bend(count, t, alphas, peaks, sharpnesses)
        excess = _log_twice(max(product, _TINY))
        if excess > ZERO:
            low = t
        else:
            high = t
        turns = ONE / max(slope, _LEAST_SLOPE)
        newton = excess * turns
        bend = min(max(ONE + HALF * newton * growth * turns, _LEAST_BEND), _MOST_BEND)
        step = newton / bend
        size = abs(step)
        sigmas = size * sharpest
        found_slope = slope
        closed = abs(excess) <= _LEVEL_MARGIN or high - low <= _BRACKET_SHARE * high
        if closed or sigmas < _STEP_SIGMAS:
            # Rounding may put a step this small on the bracket's end.
            if sigmas < _POLISH_SIGMAS:
                moved = min(max(t + step, low), high)
                found_slope = slope + growth * (moved - t)
                t = moved
            found_slope = max(found_slope, SLOPE_FLOOR * alone)
            if abs(excess) > _LEVEL_FAR and slope < _FLAT * alone:
                found_slope = TWO * alone
            break
        least = _LEAST_SHARE * t
        moved = t + (step if size > least else (least if excess > ZERO else -least))
        newton_next = moved > low and moved < high
        newton_next = newton_next and (number < _NEWTON_STEPS or number % 2 == 0)
        t = moved if newton_next else HALF * (low + high)
    return t, max(found_slope, SLOPE_FLOOR * alone)


@functools.cache
def query_kernel(solve: bool) -> Any:
    """Return the kernel that answers positions, compiled on first call.

    Parameters
    ----------
    solve : bool
        Find the depth of the isosurface; otherwise evaluate the transmittance at given depths.
    """

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
        places: np.ndarray,
        limit: float,
        depths: np.ndarray,
        values: np.ndarray,
        slopes: np.ndarray,
        stops: np.ndarray,
    ) -> None:
        """Answer the positions of tiles: write ``values`` and ``slopes``, read ``depths``.

        ``depths (k,)`` is what is written where the depth is solved. ``stops (k,) int32`` receives
        the number of Gaussians of the cell's list that come before the light is used up.
        """
        longest = longest_list(first_tile, end_tile, start, shift, cell_start)
        room = (longest + _SPAN - 1) // _SPAN
        tile_spans = np.empty((room, _TILE_COLUMNS * _SPAN), np.float32)
        spans = np.empty((room, _FORWARD_COLUMNS * _SPAN), np.float32)
        fronts = np.empty(room + 1, np.float32)
        members = np.empty(longest, np.int64)
        alphas = np.empty(room * _SPAN, np.float32)
        peaks = np.empty(room * _SPAN, np.float32)
        sharpnesses = np.empty(room * _SPAN, np.float32)
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
                _FORWARD_COLUMNS, cell & ((1 << (2 * shift)) - 1), shift,
                start[tile + 1] - start[tile], tile_spans, spans, fronts, members,
            )  # fmt: skip
            for p in range(cell_start[cell], cell_start[cell + 1]):
                x, y = places[p, 0], places[p, 1]
                through, high = ONE, ZERO
                before_crossing, crossing = ZERO, 0
                count: Any = 0
                stop: Any = total
                end = depths[p]
                for at in range((total + _SPAN - 1) // _SPAN):
                    if solve:
                        if through <= limit and through < ISO_LEVEL and fronts[at] >= high:
                            break
                    elif fronts[at] >= end:
                        break
                    span = spans[at]
                    _cast(span, x, y)
                    spent = False
                    for run in range(0, _SPAN, _RUN):
                        hits = positive_run(_RUN, span, _RAW + run)
                        while hits != np.uint64(0):
                            j = run + np.int64(lowest_bit(hits))
                            hits &= hits - np.uint64(1)
                            raw, peak = span[_RAW + j], span[_PEAK + j]
                            alphas[count] = raw
                            peaks[count] = peak
                            sharpnesses[count] = span[_SHARPNESS + j]
                            before = through
                            through -= min(raw, ALPHA_MAX) * through
                            if solve and before > ISO_LEVEL:
                                high = max(high, peak)
                                if through <= ISO_LEVEL:
                                    before_crossing, crossing = before, count
                            count += 1
                            if through < TRANSMITTANCE_MIN:
                                stop = at * _SPAN + j + 1
                                spent = True
                                break
                        if spent:
                            break
                    if spent:
                        break
                stops[p] = stop
                if not solve:
                    values[p], slopes[p] = _evaluate(True, count, end, alphas, peaks, sharpnesses)
                    continue
                values[p], slopes[p] = ZERO, ONE
                if not (before_crossing > ZERO and through <= limit and through < ISO_LEVEL):
                    continue
                sharpest = ZERO
                kept = 0
                for c in range(count):
                    sharpness, peak = sharpnesses[c], peaks[c]
                    beyond = max(peak - high, ZERO)
                    matters = sharpness * beyond * beyond < _NEGLIGIBLE
                    if c == crossing:
                        crossing = kept
                    alphas[kept] = alphas[c]
                    peaks[kept] = peak
                    sharpnesses[kept] = sharpness
                    if matters:
                        sharpest = max(sharpest, sharpness)
                        kept += 1
                if fronts[0] <= ZERO:
                    # Some Gaussian may reach the camera: light must pass at depth 0.
                    product, _ = _evaluate(False, kept, ZERO, alphas, peaks, sharpnesses)
                    if product <= ISO_LEVEL:
                        continue
                # Alone, the Gaussian at the crossing lets 0.5 through where its fall-off is ratio.
                light = min(alphas[crossing], ALPHA_MAX) * before_crossing
                ratio = min(max((before_crossing - ISO_LEVEL) / max(light, _TINY), ZERO), ONE)
                log_ratio = math.log(max(ratio, _TINY))
                ahead = math.sqrt(max(-TWO * log_ratio / max(sharpnesses[crossing], _TINY), ZERO))
                guess = peaks[crossing] - ahead
                if not (guess > ZERO and guess < high):
                    guess = HALF * high
                values[p], slopes[p] = _solve(
                    kept, alphas, peaks, sharpnesses, high, guess,
                    math.sqrt(max(sharpest, _TINY)), math.sqrt(max(sharpnesses[crossing], _TINY)),
                )  # fmt: skip

    return query_range


@inline
def _pull_span(span: Any, x: Any, y: Any, t: Any, weight: Any, stop: Any) -> Any:
    """Add the gradient of ``weight log T(t)`` on a span; return that on the position."""
    sum_x, sum_y = ZERO, ZERO
    for j in range(_SPAN):
        qa, qb, qc = span[_QA + j], span[_QB + j], span[_QC + j]
        px, py = span[_PX + j], span[_PY + j]
        r, s, v = span[_R + j], span[_S + j], span[_T + j]
        dx = x - span[_U + j]
        dy = y - span[_V + j]
        shift = dx * px + dy * py
        num = max((dx * qa + dy * qb) * dx + dy * dy * qc, ZERO)
        den = dx * dx * r + dx * dy * s + dy * dy * v
        den = max(den + TWO * shift + ONE, DENOMINATOR_MIN)
        inverse = ONE / den
        distance = num * inverse
        raw = exp_short(HALF * distance) * span[_OPACITY + j]
        contributes = (raw >= ALPHA_MIN) & (_INDEX[j] < stop)
        peak = (shift + ONE) * inverse * span[_Z + j]
        ahead = max(peak - t, ZERO)
        sharpness = span[_A0 + j] * den
        density = raw * exp_wide(HALF * sharpness * ahead * ahead)
        free = contributes & (density < ALPHA_MAX)
        density = density if free else ZERO
        g_log = -weight * density / (ONE - density)
        g_distance = -HALF * g_log
        g_peak = -g_log * sharpness * ahead
        g_sharpness = g_distance * ahead * ahead
        g_num = g_distance * inverse
        g_den = span[_A0 + j] * g_sharpness - (g_num * distance + g_peak * peak * inverse)
        g_shift = g_peak * inverse * span[_Z + j] + TWO * g_den
        g_x = g_num * (TWO * qa * dx + qb * dy) + g_den * (TWO * r * dx + s * dy) + g_shift * px
        g_y = g_num * (TWO * qc * dy + qb * dx) + g_den * (TWO * v * dy + s * dx) + g_shift * py
        sum_x += g_x
        sum_y += g_y
        span[_G + _U + j] -= g_x
        span[_G + _V + j] -= g_y
        span[_G + _QA + j] += g_num * dx * dx
        span[_G + _QB + j] += g_num * dx * dy
        span[_G + _QC + j] += g_num * dy * dy
        span[_G + _PX + j] += g_shift * dx
        span[_G + _PY + j] += g_shift * dy
        span[_G + _R + j] += g_den * dx * dx
        span[_G + _S + j] += g_den * dx * dy
        span[_G + _T + j] += g_den * dy * dy
        span[_G + _Z + j] += g_peak * peak
        span[_G + _OPACITY + j] += g_log
        span[_G + _A0 + j] += g_sharpness * den
    return sum_x, sum_y


@kernel(fast=True)
def pull_range(
    first_tile: int,
    end_tile: int,
    params: np.ndarray,
    boxes: np.ndarray,
    skews: np.ndarray,
    start: np.ndarray,
    gaussian_ids: np.ndarray,
    pair_slots: np.ndarray,
    tiles_x: int,
    shift: int,
    cell_start: np.ndarray,
    places: np.ndarray,
    depths: np.ndarray,
    weights: np.ndarray,
    stops: np.ndarray,
    pair_grads: np.ndarray,
    grad_places: np.ndarray,
) -> None:
    """Write the gradient of ``sum weights * log T(depths)`` for the positions of tiles.

    Parameters
    ----------
    depths, weights : (k,) float32
    stops : (k,) int32
        As :func:`query_kernel` wrote them.
    pair_grads : (pairs, 13) float32
        Zero; each pair adds up at its slot, cell after cell.
    grad_places : (k, 2) float32
    """
    longest = longest_list(first_tile, end_tile, start, shift, cell_start)
    room = (longest + _SPAN - 1) // _SPAN
    tile_spans = np.empty((room, _TILE_COLUMNS * _SPAN), np.float32)
    spans = np.empty((room, _GRADIENT_COLUMNS * _SPAN), np.float32)
    fronts = np.empty(room + 1, np.float32)
    members = np.empty(longest, np.int64)
    filled = -1
    for cell in range(first_tile << (2 * shift), end_tile << (2 * shift)):
        idle = True
        for p in range(cell_start[cell], cell_start[cell + 1]):
            grad_places[p, 0] = ZERO
            grad_places[p, 1] = ZERO
            idle &= weights[p] == ZERO
        if idle:
            continue
        tile = cell >> (2 * shift)
        if tile != filled:
            fill_tile(tile, tiles_x, params, boxes, skews, start, gaussian_ids, tile_spans)
            filled = tile
        total = fill_cell(
            _GRADIENT_COLUMNS, cell & ((1 << (2 * shift)) - 1), shift,
            start[tile + 1] - start[tile], tile_spans, spans, fronts, members,
        )  # fmt: skip
        for at in range((total + _SPAN - 1) // _SPAN):
            spans[at, _G:] = ZERO
        reached = 0
        for p in range(cell_start[cell], cell_start[cell + 1]):
            if weights[p] == ZERO:
                continue
            x, y, t = places[p, 0], places[p, 1], depths[p]
            sum_x, sum_y = ZERO, ZERO
            for at in range((total + _SPAN - 1) // _SPAN):
                if fronts[at] >= t or at * _SPAN >= stops[p]:
                    break
                stop = np.float32(stops[p] - at * _SPAN)
                reached = max(reached, at + 1)
                g_x, g_y = _pull_span(spans[at], x, y, t, weights[p], stop)
                sum_x += g_x
                sum_y += g_y
            grad_places[p, 0] = sum_x
            grad_places[p, 1] = sum_y
        for g in range(min(total, reached * _SPAN)):
            out = pair_grads[pair_slots[start[tile] + members[g]]]
            span = spans[g // _SPAN]
            lane = g % _SPAN
            for column in range(10):
                out[column] += span[_G + column * _SPAN + lane]
            out[10] += span[_G + _Z + lane] / span[_Z + lane]
            out[11] += span[_G + _OPACITY + lane] / span[_OPACITY + lane]
            out[12] += span[_G + _A0 + lane]


@kernel(fast=False)
def add_pair_gradients(
    first: int, end: int, pair_grads: np.ndarray, pair_offsets: np.ndarray, grad_params: np.ndarray
) -> None:
    """Add the pairs of the Gaussians ``first .. end``, in the order of their slots."""
    total = np.zeros(GEOMETRY, np.float32)
    for i in range(first, end):
        if pair_offsets[i] == pair_offsets[i + 1]:
            continue
        total[:] = ZERO
        for slot in range(pair_offsets[i], pair_offsets[i + 1]):
            for column in range(GEOMETRY):
                total[column] += pair_grads[slot, column]
        for column in range(GEOMETRY):
            grad_params[i, column] += total[column]
