# SPDX-License-Identifier: GPL-3.0-or-later
"""One sweep of PatchMatch over a photo: planes spread between pixels and are refined.

See docs/method.md, section 11.3.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..kernels.compiled import kernel, part
from .matching_cost import AT_X, AT_Y, REACH_PX, SAMPLES, WINDOW, WORST_COST, fill_window, view_cost
from .plane_kernels import F32, HALF, ONE, TWO, ZERO, normal_of, random_share, slopes_of

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
        Of the sources (:func:`~.matching_cost.window_cost`); ``sizes`` is (s, 2) float32, last
        column and row.
    brightness : (s, 2) float32
        Of the sources (:func:`~.consistency.brightness_of`).
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
