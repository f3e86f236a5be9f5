# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth at any sub-pixel position: kernels."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from .. import limits
from ..compiled import inline, kernel, part
from ..parallel import default_threads, even_bounds, run_chunks
from ..scene.camera import Camera
from .area_lists import PIXEL_MARGIN, SHARE_MARGIN, TILE
from .projection import RawArrays, ScreenGaussians, project_gaussians
from .simd import (
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
    lowest_bit,
    positive_run,
    prefetch_row,
)
from .types import RenderOptions

# -- Projection that keeps the Gaussians between pixel centres, using a finer screen --------------
#
# Projection drops Gaussians that reach no pixel centre. Queries between the centres need them, so
# Gaussians are projected onto a much finer screen and their rows scaled back to pixels.


_FINE_SIDE_PX = 65536
"""Longer side of the screen that Gaussians are projected onto for queries. Projection drops those
between pixel centres; at this size none of them is relevant."""
BOX_END = 0.999e9
"""Projection clips boxes at 1e9 pixels."""


def fine_scale(camera: Camera) -> int:
    """Return how many times as fine the screen is that Gaussians are projected onto."""
    scale = 1
    while scale * max(camera.width, camera.height) < _FINE_SIDE_PX:
        scale *= 2
    return scale


def project_finely(gaussians: RawArrays, camera: Camera, options: RenderOptions) -> ScreenGaussians:
    """Project onto a screen finer by a power of two, and scale the rows back to pixels.

    Arguments as for :func:`~.projection.project_gaussians`. The result is in pixels of ``camera``;
    Gaussians that rendering hides at that size are hidden.
    """
    threads = options.threads or default_threads()
    scale = fine_scale(camera)
    fine = camera.resized(camera.width * scale, camera.height * scale)
    screen = project_gaussians(gaussians, fine, options)

    def shrink(begin: int, end: int) -> None:
        _shrink_range(
            begin, end, float(scale), camera.width, camera.height,
            screen.params, screen.boxes, screen.skews, screen.visible,
        )  # fmt: skip

    run_chunks(shrink, even_bounds(len(screen), threads), threads)
    _add_distant(gaussians, camera, options, scale, screen)
    return screen


def _add_distant(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    scale: int,
    screen: ScreenGaussians,
) -> None:
    """Add Gaussians that are hidden only because they exceed the pixel range of the finer screen.

    They project more than a hundred image sizes off the image.
    """
    hidden = np.flatnonzero(~screen.visible)
    pose = camera.cam_from_world
    with np.errstate(all="ignore"):
        local = gaussians.means[hidden].astype(np.float64) @ pose[:, :3].T + pose[:, 3]
        aside = np.abs(
            local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        )
    limit = limits.FINITE_OFFSET_PX / scale - max(camera.width, camera.height) - limits.TILE_PX
    far = hidden[(local[:, 2] > 0.0) & (aside.max(1) > limit)]
    if len(far) == 0:
        return
    names = [field.name for field in dataclasses.fields(RawArrays)]
    some = RawArrays(**{name: getattr(gaussians, name)[far] for name in names})
    coarse = project_gaussians(some, camera, options)
    seen = far[coarse.visible]
    for field in dataclasses.fields(ScreenGaussians):
        getattr(screen, field.name)[seen] = getattr(coarse, field.name)[coarse.visible]


@kernel(fast=False)
def _shrink_range(
    begin: int, end: int, scale: float, width: int, height: int, params: np.ndarray,
    boxes: np.ndarray, skews: np.ndarray, visible: np.ndarray,
) -> None:  # fmt: skip
    """Scale the rows ``begin .. end`` of a screen ``scale`` times as fine to pixels.

    Rows that the image of ``width`` x ``height`` hides because rendering them would overflow
    float32 (docs/architecture.md) are hidden.
    """
    for i in range(begin, end):
        if not visible[i]:
            continue
        # Only these columns depend on the pixel size.
        u, v = params[i, 0] / scale, params[i, 1] / scale
        reach_x = max(abs(u), abs(width - u)) + TILE
        reach_y = max(abs(v), abs(height - v)) + TILE
        xx, xy, yy = reach_x * reach_x, reach_x * reach_y, reach_y * reach_y
        square = scale * scale
        qa, qb, qc = params[i, 2] * square, params[i, 3] * square, params[i, 4] * square
        px, py = params[i, 5] * scale, params[i, 6] * scale
        r, s, t = params[i, 7] * square, params[i, 8] * square, params[i, 9] * square
        den = 1.0 + 2.0 * (abs(px) * reach_x + abs(py) * reach_y) + r * xx + abs(s) * xy + t * yy
        holds = reach_x <= limits.FINITE_OFFSET_PX and reach_y <= limits.FINITE_OFFSET_PX
        holds &= qa * xx + abs(qb) * xy + qc * yy <= limits.FINITE_NUM
        holds &= den <= limits.FINITE_DEN
        holds &= params[i, 12] * den * params[i, 10] <= limits.FINITE_PULL
        visible[i] = holds
        if not holds:
            continue
        for column, value in enumerate((u, v, qa, qb, qc, px, py, r, s, t)):
            params[i, column] = value
        skews[i] /= scale
        for column in range(4):
            if abs(boxes[i, column]) > BOX_END:
                # Clipped, far outside the image: no longer the box of the ellipse.
                skews[i] = math.inf
            boxes[i, column] /= scale


# -- The Gaussians that reach a cell of a tile, in a layout for vectorised loops ------------------
#
# Vectors run over the Gaussians of a cell, not over positions, so that a single position costs no
# more than one of many. The Gaussians of a cell are stored in *spans* of 32, column by column
# with 32 values each, in one array at constant offsets, which is what lets LLVM vectorise.


GEOMETRY = 13
"""Leading columns of params that a ray's transmittance depends on."""

SPAN = 32
RUN = 16
"""Values of a span tested at once."""
# Columns of a span: the Gaussians; kernels append columns of their own.
U, V, QA, QB, QC = 0, SPAN, 2 * SPAN, 3 * SPAN, 4 * SPAN
PX, PY, R, S, T = 5 * SPAN, 6 * SPAN, 7 * SPAN, 8 * SPAN, 9 * SPAN
Z, OPACITY, A0 = 10 * SPAN, 11 * SPAN, 12 * SPAN
# Columns of a tile's span: the Gaussians, the nearest depth they reach, and their ellipses.
_NEAREST, _CENTER_X, _CENTER_Y, _SKEW = 13 * SPAN, 14 * SPAN, 15 * SPAN, 16 * SPAN
_EXTREME, _INVERSE, _ACROSS, _MARGIN = 17 * SPAN, 18 * SPAN, 19 * SPAN, 20 * SPAN
_INTERSECTS = 21 * SPAN
TILE_COLUMNS = 22
_FLOAT_MARGIN = np.float32(4e-6)
"""A few float32 rounding errors, relative."""


@part(fast=False)
def fill_tile(
    tile: int, tiles_x: int, params: np.ndarray, boxes: np.ndarray, skews: np.ndarray,
    start: np.ndarray, gaussian_ids: np.ndarray, spans: np.ndarray,
) -> None:  # fmt: skip
    """Store the Gaussians of a tile and their ellipses in ``spans (s, 22 * 32) float32``."""
    left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
    count = start[tile + 1] - start[tile]
    for k in range(count):
        ahead = start[tile] + min(k + PREFETCH_AHEAD, count - 1)
        prefetch_row(params, np.int64(gaussian_ids[ahead]))
        i = gaussian_ids[start[tile] + k]
        span = spans[k // SPAN]
        lane = k % SPAN
        for column in range(GEOMETRY):
            span[column * SPAN + lane] = params[i, column]
        span[_NEAREST + lane] = params[i, 10] - FRONT_SIGMAS * params[i, 22]
        half_x = 0.5 * (np.float64(boxes[i, 2]) - np.float64(boxes[i, 0]))
        half_y = 0.5 * (np.float64(boxes[i, 3]) - np.float64(boxes[i, 1]))
        skew = np.float64(skews[i])
        if math.isinf(skew) or not (half_x > 0.0 and half_y > 0.0):
            # No ellipse that could exclude a cell.
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
    for k in range(count, (count + SPAN - 1) // SPAN * SPAN):
        span = spans[k // SPAN]
        for column in range(TILE_COLUMNS):
            span[column * SPAN + k % SPAN] = ZERO
        span[_NEAREST + k % SPAN] = FAR
        span[_CENTER_X + k % SPAN] = -FAR


@inline
def _mark_intersecting(span: Any, x0: Any, y0: Any, x1: Any, y1: Any) -> None:
    """Mark with 1 the ellipses of a span that reach a rectangle, see ``area_lists.strip_span``."""
    for j in range(SPAN):
        inverse, center_y = span[_INVERSE + j], span[_CENTER_Y + j]
        first = max((y0 - center_y) * inverse - _FLOAT_MARGIN, -ONE)
        last = min((y1 - center_y) * inverse + _FLOAT_MARGIN, ONE)
        extreme, skew, across = span[_EXTREME + j], span[_SKEW + j], span[_ACROSS + j]
        t = min(max(extreme, first), last)
        right = skew * t + across * math.sqrt(max(ONE - t * t, ZERO))
        t = min(max(-extreme, first), last)
        left = skew * t - across * math.sqrt(max(ONE - t * t, ZERO))
        center_x, margin = span[_CENTER_X + j], span[_MARGIN + j]
        intersects = (first <= last) & (center_x + right + margin >= x0)
        intersects = intersects & (center_x + left - margin <= x1)
        span[_INTERSECTS + j] = ONE if intersects else ZERO


@part(fast=True)
def fill_cell(
    columns: int, part: int, shift: int, count: int, tile_spans: np.ndarray, spans: np.ndarray,
    nearest_depths: np.ndarray, members: np.ndarray,
) -> int:  # fmt: skip
    """Store the Gaussians of a tile that reach one of its cells; return their number.

    ``part`` is the cell within its tile, whose ``count`` Gaussians :func:`fill_tile` wrote to
    ``tile_spans``. ``spans (s, columns * 32)`` is padded with Gaussians of opacity 0;
    ``nearest_depths (s + 1,)`` receives the z-depth in front of which every Gaussian of a span and
    later ones has negligible density, ``members`` each Gaussian's index in the tile's list.
    """
    cell_px = TILE >> shift
    margin = np.float32(PIXEL_MARGIN)
    x0 = np.float32((part & ((1 << shift) - 1)) * cell_px)
    y0 = np.float32((part >> shift) * cell_px)
    x1, y1 = x0 + np.float32(cell_px), y0 + np.float32(cell_px)
    total: Any = 0
    for at in range((count + SPAN - 1) // SPAN):
        source = tile_spans[at]
        if shift > 0:
            _mark_intersecting(source, x0, y0 - margin, x1, y1 + margin)
        else:
            for lane in range(SPAN):
                source[_INTERSECTS + lane] = ONE if at * SPAN + lane < count else ZERO
        for run in range(0, SPAN, RUN):
            hits = positive_run(RUN, source, _INTERSECTS + run)
            while hits != np.uint64(0):
                j = run + np.int64(lowest_bit(hits))
                hits &= hits - np.uint64(1)
                target = spans[total // SPAN]
                lane = total % SPAN
                for column in range(GEOMETRY):
                    target[column * SPAN + lane] = source[column * SPAN + j]
                nearest, to = source[_NEAREST + j], total // SPAN
                nearest_depths[to] = nearest if lane == 0 else min(nearest_depths[to], nearest)
                members[total] = at * SPAN + j
                total += 1
    last = (total + SPAN - 1) // SPAN
    for k in range(total, last * SPAN):
        for column in range(columns):
            spans[last - 1, column * SPAN + k % SPAN] = ZERO
    nearest_depths[last] = FAR
    for at in range(last - 1, -1, -1):
        nearest_depths[at] = min(nearest_depths[at], nearest_depths[at + 1])
    return total


@part(fast=False)
def longest_list(
    first_tile: int, end_tile: int, start: np.ndarray, shift: int, cell_start: np.ndarray
) -> int:
    """Return the length of the longest list of the tiles that contain positions."""
    longest = 0
    for tile in range(first_tile, end_tile):
        if cell_start[tile << (2 * shift)] < cell_start[(tile + 1) << (2 * shift)]:
            longest = max(longest, start[tile + 1] - start[tile])
    return longest


# -- Solver of the 0.5-isosurface depth along a single ray ----------------------------------------
#
# The contributors are three parallel arrays: opacities before the cap of 0.99, z-depths of the
# peaks, sharpnesses 1 / sigma^2 along the ray. The crossing is solved by Newton steps on ``log
# T`` inside a bracket (docs/method.md, section 2.4).


# Converged: a step so small relative to the thinnest Gaussian's sigma along the ray that the
# second-order Taylor series of log T is exact in float32 ...
_STEP_SIGMAS = np.float32(5e-4)
# ... or a transmittance equal to 0.5 within its own rounding error ...
_LEVEL_MARGIN = np.float32(1.2e-7)
# ... or a bracket as narrow as the rounding error of the depth. A step below that error is not
# sufficient: a layer may be steep there and yet end before the level is reached.
_BRACKET_SHARE = np.float32(1.25e-7)
_MIN_STEP_SHARE = np.float32(1.25e-7)
"""Minimum step relative to the depth, so that steps can close the bracket."""
_POLISH_SIGMAS = np.float32(3e-3)
"""Longest final step. A longer one would leave the depth at which the slope is known, by which
gradients are divided; where T is nearly flat, its rounding error would make the step far too
long."""
_LEVEL_FAR, _FLAT = np.float32(0.05), np.float32(0.02)
"""For a layer thinner than the depth's rounding error, T jumps past 0.5 from a flat part and the
gradient is lost: too small is better than a thousand times too large."""
_MIN_SLOPE = np.float32(1e-12)
"""Keeps a step finite; such a step leaves the bracket."""
# Bounds of Halley's correction factor of a Newton step.
_MIN_CORRECTION, _MAX_CORRECTION = HALF, TWO
_NEWTON_STEPS = 8
"""After these, every second step is a bisection, which bounds the number of steps."""
_MAX_STEPS = 80
SLOPE_FLOOR = np.float32(limits.SLOPE_FLOOR)
"""Floor of -d(log T)/dt relative to 1/sigma along the ray of the Gaussian at which the blending
crosses 0.5 (docs/method.md, section 2.5)."""
_THIRD, _FIFTH = np.float32(1.0 / 3.0), np.float32(0.2)
# exp(-x / 2) is below 3e-7 beyond this x = sharpness d^2.
NEGLIGIBLE = np.float32(30.0)
TINY = np.float32(1e-30)


@inline
def transmittance_at(count: Any, t: Any, alphas: Any, peaks: Any, sharpnesses: Any) -> Any:
    """Return T at depth t."""
    product = ONE
    for c in range(count):
        ahead = max(peaks[c] - t, ZERO)
        density = alphas[c] * exp_wide(HALF * sharpnesses[c] * ahead * ahead)
        product *= ONE - min(density, ALPHA_MAX)
    return product


@inline
def _log_twice(value: Any) -> Any:
    """Return log(2 value), accurate near 0.5, with correct sign and monotonic elsewhere."""
    y = (TWO * value - ONE) / (TWO * value + ONE)
    square = y * y
    return TWO * y * (ONE + square * (_THIRD + square * _FIFTH))


@inline
def _log_derivatives(count: Any, t: Any, alphas: Any, peaks: Any, sharpnesses: Any) -> Any:
    """Return T, the slope -d(log T)/dt and the derivative of the slope, at depth t."""
    product, slope, growth = ONE, ZERO, ZERO
    for c in range(count):
        ahead = max(peaks[c] - t, ZERO)
        fall = HALF * sharpnesses[c] * ahead * ahead
        density = min(alphas[c] * exp_wide(fall), ALPHA_MAX)
        # 0 where the density does not depend on t; far behind, the square below could overflow.
        sharpness = sharpnesses[c] if ahead > ZERO and fall <= WIDE_END else ZERO
        log_slope = sharpness * ahead
        keep = ONE - density
        product *= keep
        odds = density / keep
        slope += odds * log_slope
        growth += odds * (log_slope * log_slope / keep - sharpness)
    return product, slope, growth


@inline
def solve_ray(
    count: Any, alphas: Any, peaks: Any, sharpnesses: Any, high: Any, guess: Any, sharpest: Any,
    alone: Any,
) -> Any:  # fmt: skip
    """Return where T crosses 0.5 between 0 and ``high``, and -d(log T)/dt there, floored."""
    t, low, found_slope = guess, ZERO, ZERO
    for number in range(_MAX_STEPS):
        product, slope, growth = _log_derivatives(count, t, alphas, peaks, sharpnesses)
        excess = _log_twice(max(product, TINY))
        if excess > ZERO:
            low = t
        else:
            high = t
        inverse_slope = ONE / max(slope, _MIN_SLOPE)
        newton = excess * inverse_slope
        correction = min(
            max(ONE + HALF * newton * growth * inverse_slope, _MIN_CORRECTION), _MAX_CORRECTION
        )
        step = newton / correction
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
        least = _MIN_STEP_SHARE * t
        moved = t + (step if size > least else (least if excess > ZERO else -least))
        newton_next = moved > low and moved < high
        newton_next = newton_next and (number < _NEWTON_STEPS or number % 2 == 0)
        t = moved if newton_next else HALF * (low + high)
    return t, max(found_slope, SLOPE_FLOOR * alone)


# -- Compiled query at positions of a view: the depth of the isosurface ---------------------------


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
    first_tile: int, end_tile: int, params: np.ndarray, boxes: np.ndarray, skews: np.ndarray,
    start: np.ndarray, gaussian_ids: np.ndarray, tiles_x: int, shift: int, cell_start: np.ndarray,
    coordinates: np.ndarray, limit: float, values: np.ndarray, slopes: np.ndarray,
    stops: np.ndarray,
) -> None:  # fmt: skip
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
