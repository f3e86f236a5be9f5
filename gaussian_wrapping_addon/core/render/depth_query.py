# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth at any sub-pixel position, and its gradient."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..compiled import inline, kernel
from ..errors import UsageError
from ..parallel import CHUNKS_PER_THREAD, balanced_bounds, default_threads, even_bounds, run_chunks
from ..scene.camera import Camera
from .area_lists import AreaLists, SortedPositions, list_areas, sort_positions
from .projection import RawArrays, ScreenGaussians
from .query_kernels import (
    A0,
    GEOMETRY,
    OPACITY,
    PX,
    PY,
    QA,
    QB,
    QC,
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
    project_finely,
    query_range,
)
from .simd import ALPHA_MAX, ALPHA_MIN, DENOMINATOR_MIN, HALF, ONE, TWO, ZERO, exp_short, exp_wide
from .types import RenderOptions

# -- Compiled gradients of ``log T`` at depths and positions, summed per tile intersection --------
#
# A depth's gradient is one of these over the slope of ``log T`` (docs/method.md, section 2.5).


# Columns of a span after those of the Gaussians: the gradients on them.
_G = GEOMETRY * SPAN
_COLUMNS = 2 * GEOMETRY
_INDEX = np.arange(SPAN, dtype=np.float32)


@inline
def _span_gradient(span: Any, x: Any, y: Any, t: Any, weight: Any, stop: Any) -> Any:
    """Add the gradient of ``weight log T(t)`` to a span's; return that on the position."""
    sum_x, sum_y = ZERO, ZERO
    for j in range(SPAN):
        qa, qb, qc = span[QA + j], span[QB + j], span[QC + j]
        px, py = span[PX + j], span[PY + j]
        r, s, v = span[R + j], span[S + j], span[T + j]
        dx = x - span[U + j]
        dy = y - span[V + j]
        shift = dx * px + dy * py
        num = max((dx * qa + dy * qb) * dx + dy * dy * qc, ZERO)
        den = dx * dx * r + dx * dy * s + dy * dy * v
        den = max(den + TWO * shift + ONE, DENOMINATOR_MIN)
        inverse = ONE / den
        distance = num * inverse
        raw = exp_short(HALF * distance) * span[OPACITY + j]
        contributes = (raw >= ALPHA_MIN) & (_INDEX[j] < stop)
        peak = (shift + ONE) * inverse * span[Z + j]
        ahead = max(peak - t, ZERO)
        sharpness = span[A0 + j] * den
        density = raw * exp_wide(HALF * sharpness * ahead * ahead)
        free = contributes & (density < ALPHA_MAX)
        density = density if free else ZERO
        g_log = -weight * density / (ONE - density)
        g_distance = -HALF * g_log
        g_peak = -g_log * sharpness * ahead
        g_sharpness = g_distance * ahead * ahead
        g_num = g_distance * inverse
        g_den = span[A0 + j] * g_sharpness - (g_num * distance + g_peak * peak * inverse)
        g_shift = g_peak * inverse * span[Z + j] + TWO * g_den
        g_x = g_num * (TWO * qa * dx + qb * dy) + g_den * (TWO * r * dx + s * dy) + g_shift * px
        g_y = g_num * (TWO * qc * dy + qb * dx) + g_den * (TWO * v * dy + s * dx) + g_shift * py
        sum_x += g_x
        sum_y += g_y
        span[_G + U + j] -= g_x
        span[_G + V + j] -= g_y
        span[_G + QA + j] += g_num * dx * dx
        span[_G + QB + j] += g_num * dx * dy
        span[_G + QC + j] += g_num * dy * dy
        span[_G + PX + j] += g_shift * dx
        span[_G + PY + j] += g_shift * dy
        span[_G + R + j] += g_den * dx * dx
        span[_G + S + j] += g_den * dx * dy
        span[_G + T + j] += g_den * dy * dy
        span[_G + Z + j] += g_peak * peak
        span[_G + OPACITY + j] += g_log
        span[_G + A0 + j] += g_sharpness * den
    return sum_x, sum_y


@kernel(fast=True)
def query_gradient_range(
    first_tile: int, end_tile: int, params: np.ndarray, boxes: np.ndarray, skews: np.ndarray,
    start: np.ndarray, gaussian_ids: np.ndarray, intersection_slots: np.ndarray, tiles_x: int,
    shift: int, cell_start: np.ndarray, coordinates: np.ndarray, depths: np.ndarray,
    weights: np.ndarray, stops: np.ndarray, intersection_grads: np.ndarray,
    grad_coordinates: np.ndarray,
) -> None:  # fmt: skip
    """Write the gradient of ``sum weights * log T(depths)`` for the positions of tiles.

    ``stops`` are those of :func:`~.query_kernels.query_range`. ``intersection_grads
    (intersections, 13)`` is zero on entry; each intersection accumulates at its slot, cell by cell.
    """
    longest = longest_list(first_tile, end_tile, start, shift, cell_start)
    room = (longest + SPAN - 1) // SPAN
    tile_spans = np.empty((room, TILE_COLUMNS * SPAN), np.float32)
    spans = np.empty((room, _COLUMNS * SPAN), np.float32)
    nearest_depths = np.empty(room + 1, np.float32)
    members = np.empty(longest, np.int64)
    filled = -1
    for cell in range(first_tile << (2 * shift), end_tile << (2 * shift)):
        idle = True
        for p in range(cell_start[cell], cell_start[cell + 1]):
            grad_coordinates[p, 0] = ZERO
            grad_coordinates[p, 1] = ZERO
            idle &= weights[p] == ZERO
        if idle:
            continue
        tile = cell >> (2 * shift)
        if tile != filled:
            fill_tile(tile, tiles_x, params, boxes, skews, start, gaussian_ids, tile_spans)
            filled = tile
        total = fill_cell(
            _COLUMNS, cell & ((1 << (2 * shift)) - 1), shift,
            start[tile + 1] - start[tile], tile_spans, spans, nearest_depths, members,
        )  # fmt: skip
        for at in range((total + SPAN - 1) // SPAN):
            spans[at, _G:] = ZERO
        reached = 0
        for p in range(cell_start[cell], cell_start[cell + 1]):
            if weights[p] == ZERO:
                continue
            x, y, t = coordinates[p, 0], coordinates[p, 1], depths[p]
            sum_x, sum_y = ZERO, ZERO
            for at in range((total + SPAN - 1) // SPAN):
                if nearest_depths[at] >= t or at * SPAN >= stops[p]:
                    break
                stop = np.float32(stops[p] - at * SPAN)
                reached = max(reached, at + 1)
                g_x, g_y = _span_gradient(spans[at], x, y, t, weights[p], stop)
                sum_x += g_x
                sum_y += g_y
            grad_coordinates[p, 0] = sum_x
            grad_coordinates[p, 1] = sum_y
        for g in range(min(total, reached * SPAN)):
            out = intersection_grads[intersection_slots[start[tile] + members[g]]]
            span = spans[g // SPAN]
            lane = g % SPAN
            for column in range(10):
                out[column] += span[_G + column * SPAN + lane]
            out[10] += span[_G + Z + lane] / span[Z + lane]
            out[11] += span[_G + OPACITY + lane] / span[OPACITY + lane]
            out[12] += span[_G + A0 + lane]


@kernel(fast=False)
def add_intersection_gradients(
    first: int,
    end: int,
    intersection_grads: np.ndarray,
    intersection_offsets: np.ndarray,
    grad_params: np.ndarray,
) -> None:
    """Add the gradients of the Gaussians ``first .. end`` over their slots, in order."""
    total = np.zeros(GEOMETRY, np.float32)
    for i in range(first, end):
        if intersection_offsets[i] == intersection_offsets[i + 1]:
            continue
        total[:] = ZERO
        for slot in range(intersection_offsets[i], intersection_offsets[i + 1]):
            for column in range(GEOMETRY):
                total[column] += intersection_grads[slot, column]
        for column in range(GEOMETRY):
            grad_params[i, column] += total[column]


# -- Isosurface depth of a view at sub-pixel positions, and its gradient --------------------------
#
# The depth is that of the image, at positions instead of pixel centres (docs/method.md, section
# 2.9): the multi-view terms project a surface point into a neighbouring view and query the depth
# there. This position moves with the Gaussians too, so the results are differentiable with
# respect to the positions as well.


_POSITION_COST = 256
"""Fixed cost of a position, in Gaussians that it evaluates."""


@dataclass(frozen=True)
class QueryView:
    """A projected view, for any number of queries."""

    gaussians: RawArrays
    camera: Camera
    options: RenderOptions
    screen: ScreenGaussians
    lists: AreaLists
    threads: int


@dataclass(frozen=True)
class QueryResult:
    """Results at m positions, and what the backward pass needs."""

    values: np.ndarray
    """(m,) float32: depth in scene units; 0 where there is none."""
    positions: SortedPositions
    found: np.ndarray  # (k,) float32 the values, sorted
    slopes: np.ndarray  # (k,) float32 -d(log T)/dt there, floored
    stops: np.ndarray  # (k,) int32


def query_view(gaussians: RawArrays, camera: Camera, options: RenderOptions) -> QueryView:
    """Project Gaussians for queries only, including those between pixel centres.

    Gaussians and camera in the scene frame; of the options ``near_z``,
    ``depth_valid_transmittance`` and ``threads`` are used. Raises ResourceError if the tile lists
    are too long to be indexed.
    """
    threads = options.threads or default_threads()
    # Colours are not needed.
    lean = dataclasses.replace(gaussians, sh=np.ascontiguousarray(gaussians.sh[:, :1]))
    screen = project_finely(lean, camera, options)
    lists = list_areas(screen, camera.width, camera.height, threads)
    return QueryView(lean, camera, options, screen, lists, threads)


def solve_depths(view: QueryView, positions: np.ndarray) -> QueryResult:
    """Solve the depth of the 0.5-isosurface at positions of a view.

    The definition is that of :func:`~.reference.render_reference`: contributors have
    ``alpha >= 1/255`` and a transmittance of at least 1e-4 before them; there is no depth where
    the final transmittance exceeds ``depth_valid_transmittance`` or where the transmittance at
    depth 0 is below one half.

    ``positions (m, 2)`` are pixels, rounded to float32; UsageError if their shape differs. The
    result is 0 where there is no depth, outside ``[0, width] x [0, height]`` and for NaN.
    """
    coordinates = np.asarray(positions)
    if coordinates.ndim != 2 or coordinates.shape[1] != 2:
        raise UsageError(
            f"Positions have the shape {coordinates.shape}.", "Give (m, 2) pixel coordinates."
        )
    at = sort_positions(coordinates, view.camera.width, view.camera.height)
    count = len(at.order)
    found, slopes = np.zeros(count, np.float32), np.ones(count, np.float32)
    stops = np.zeros(count, np.int32)
    limit = np.float32(view.options.depth_valid_transmittance)

    def run(first: int, end: int) -> None:
        query_range(
            first, end, view.screen.params, view.screen.boxes, view.screen.skews, view.lists.start,
            view.lists.gaussian_ids, view.lists.tiles_x, at.shift, at.start, at.coordinates, limit,
            found, slopes, stops,
        )  # fmt: skip

    run_chunks(run, _tile_bounds(view, at), view.threads)
    values = np.zeros(at.input_count, np.float32)
    values[at.order] = found
    return QueryResult(values, at, found, slopes, stops)


def add_query_gradients(
    view: QueryView, result: QueryResult, grads: np.ndarray, grad_params: np.ndarray
) -> np.ndarray:
    """Add the gradient of ``sum grads * values`` to that on the view's ``screen.params``.

    The gradient of a depth is that of the implicit function, with the floored slope of
    docs/method.md, section 2.5. Bitwise the same for any number of threads.

    ``grads (m,)`` are ignored for positions without a result; columns of ``grad_params (n, 24)
    float32`` from 13 on are unchanged. Returns the (m, 2) float32 gradient on the positions.
    """
    positions, lists = result.positions, view.lists
    incoming = np.asarray(grads)[positions.order].astype(np.float32)  # (k,)
    weights = np.where(result.found > 0.0, incoming / result.slopes, np.float32(0.0))
    intersection_grads = np.zeros((len(lists.gaussian_ids), GEOMETRY), np.float32)
    grad_coordinates = np.zeros((len(positions.order), 2), np.float32)

    def run(first: int, end: int) -> None:
        query_gradient_range(
            first, end, view.screen.params, view.screen.boxes, view.screen.skews, lists.start,
            lists.gaussian_ids, lists.intersection_slots, lists.tiles_x, positions.shift,
            positions.start, positions.coordinates, result.found, weights, result.stops,
            intersection_grads, grad_coordinates,
        )  # fmt: skip

    run_chunks(run, _tile_bounds(view, positions), view.threads)

    def combine(first: int, end: int) -> None:
        add_intersection_gradients(
            first, end, intersection_grads, lists.intersection_offsets, grad_params
        )

    run_chunks(combine, even_bounds(len(view.screen), view.threads), view.threads)
    grad_positions = np.zeros((len(result.values), 2), np.float32)
    grad_positions[positions.order] = grad_coordinates
    return grad_positions


def _tile_bounds(view: QueryView, positions: SortedPositions) -> np.ndarray:
    """Return bounds of chunks of tiles whose positions cost about the same."""
    lengths = np.diff(view.lists.start)
    counts = np.diff(positions.start[:: 1 << (2 * positions.shift)])
    walked = lengths >> (2 * positions.shift)
    costs = counts * (walked + _POSITION_COST) + (counts > 0) * (lengths << positions.shift)
    return balanced_bounds(costs, view.threads * CHUNKS_PER_THREAD)
