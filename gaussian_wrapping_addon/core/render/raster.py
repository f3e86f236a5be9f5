# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole images blended in bands of tiles, forward and backward: a Gaussian becomes a pixel here."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..compiled import inline, kernel
from ..parallel import run_chunks
from ..scene.camera import Camera
from .isosurface import LIST_VALUES, SOLVER_VALUES, solve_block
from .projection import RawArrays, ScreenGaussians
from .raster_blocks import (
    ALONG,
    BACKWARD_PLANES,
    BACKWARD_TRANSMITTANCE,
    BASE_SUMS,
    DEN,
    DEPTH_SUMS,
    DISTANCE,
    FEATURE,
    LIN,
    NUM,
    blend_block,
    sum_intersection_gradient,
)
from .simd import (
    BEST,
    BEST_AT,
    BLOCK_COLUMNS,
    BLOCK_WIDTH,
    FAR,
    FEATURES,
    FLOAT32_MAX,
    FORWARD_PLANES,
    FRONT_SIGMAS,
    HALF,
    LIVENESS_EVERY,
    ONE,
    PLANE,
    PREFETCH_AHEAD,
    ROW_VALUES,
    STRIDE,
    TILE,
    TRANSMITTANCE,
    TWO,
    ZERO,
    aligned_zeros,
    prefetch_row,
    prefetch_row_early,
)
from .tile_io import CONTRIBUTORS_PADDING, active_blocks, list_contributors, read_row, write_row
from .tiles import TileLists
from .types import RenderOptions

# -- Compiled backward pass of blending and isosurface depth, front to back -----------------------
#
# One scalar per pixel replaces the list of contributors: with ``q_i`` the loss gradient along
# Gaussian i's features, ``remaining = sum_{j > i} w_j q_j + ...`` starts from the images and is
# reduced on the way. The depth's gradient is that of the implicit function: each contributor adds
# ``g / a dlog(1 - G_i(t))`` (docs/method.md, section 2.5). Per Gaussian and tile only moments of
# the gradient on ``num``, ``den`` and ``1 + p.d`` are summed over pixels; the gradient on the row
# of params follows from them. Each intersection writes its own slot, so the sum per Gaussian has
# a fixed order. Blocks are processed as in the forward pass, a chunk of intersections at a time.


ABS_U, ABS_V = 22, 23
"""Columns of the intersection gradients with sums of absolute values instead of gradients."""

_SUMS = BACKWARD_PLANES * STRIDE
BACKWARD_SCRATCH = _SUMS + 2 * TILE


@inline
def _write_intersection(
    depth: Any, absolute: Any, m: Any, s: Any, params: Any, i: Any, out: Any, slot: Any
) -> None:  # fmt: skip
    """Turn an intersection's totals at ``m[s]`` into the gradient on its row of params."""
    qa, qb, qc = params[i, 2], params[i, 3], params[i, 4]
    px, py, qr, qs, qt = params[i, 5], params[i, 6], params[i, 7], params[i, 8], params[i, 9]
    den, den_x, den_y = m[s + DEN], m[s + DEN + 1], m[s + DEN + 2]
    num_x, num_y = m[s + NUM + 1], m[s + NUM + 2]
    lin = lin_x = lin_y = along = ZERO
    if depth:
        lin, lin_x, lin_y, along = m[s + LIN], m[s + LIN + 1], m[s + LIN + 2], m[s + ALONG]
    out[slot, 0] = -(
        TWO * (qa * num_x + px * den + qr * den_x) + qb * num_y + qs * den_y + px * lin
    )
    out[slot, 1] = -(
        TWO * (qc * num_y + py * den + qt * den_y) + qb * num_x + qs * den_x + py * lin
    )
    out[slot, 2], out[slot, 3], out[slot, 4] = m[s + NUM + 3], m[s + NUM + 4], m[s + NUM + 5]
    out[slot, 5], out[slot, 6] = TWO * den_x + lin_x, TWO * den_y + lin_y
    out[slot, 7], out[slot, 8], out[slot, 9] = m[s + DEN + 3], m[s + DEN + 4], m[s + DEN + 5]
    out[slot, 10] = (lin + px * lin_x + py * lin_y) / params[i, 10]
    out[slot, 11] = -TWO * m[s + DISTANCE] / params[i, 11]
    out[slot, 12] = along
    for feature in range(FEATURES):
        out[slot, 13 + feature] = m[s + FEATURE + feature]
    first = DEPTH_SUMS if depth else BASE_SUMS
    out[slot, ABS_U] = m[s + first] if absolute else ZERO
    out[slot, ABS_V] = m[s + first + 1] if absolute else ZERO


@functools.cache
def backward_kernel(lanes: int, depth: bool, absolute: bool) -> Any:
    """Return the gradient kernel for blocks of 8 or 16 pixels, compiled on first call.

    ``depth`` includes the gradient of the depth image; ``absolute`` also sums the absolute
    gradients on (u, v) per pixel (AbsGS).
    """
    block_height = lanes // BLOCK_WIDTH

    @kernel(fast=True)
    def backward_range(
        first_tile: int, end_tile: int, params: np.ndarray, start: np.ndarray,
        gaussian_ids: np.ndarray, intersection_slots: np.ndarray, masks: np.ndarray, tiles_x: int,
        width: int, height: int, color: np.ndarray, normal: np.ndarray, geometric: np.ndarray,
        alpha_image: np.ndarray, depth_image: np.ndarray, slope_image: np.ndarray,
        g_color: np.ndarray, g_normal: np.ndarray, g_geometric: np.ndarray, g_alpha: np.ndarray,
        g_depth: np.ndarray, m: np.ndarray, intersections: np.ndarray,
    ) -> None:  # fmt: skip
        """Write the gradients of the tiles' intersections to their slots, (p, 24)."""
        images = (color, normal, geometric, alpha_image, depth_image, slope_image)
        grads = (g_color, g_normal, g_geometric, g_alpha, g_depth)
        for tile in range(first_tile, end_tile):
            begin = np.int64(start[tile])
            count = np.int64(start[tile + 1]) - begin
            if count == 0:
                continue
            tile_y = tile // tiles_x * TILE
            tile_x = tile % tiles_x * TILE
            origin_y = np.float32(tile_y) + HALF
            origin_x = np.float32(tile_x) + HALF
            live_rows = min(height - tile_y, TILE)
            live_columns = min(width - tile_x, TILE)
            for row in range(TILE):
                offset = (
                    row // block_height * BLOCK_COLUMNS * lanes + row % block_height * BLOCK_WIDTH
                )
                inside = live_columns if row < live_rows else 0
                at = (tile_y + row) * width + tile_x
                read_row(lanes, depth, m, offset, inside, images, grads, at)
            live = np.uint64(0)
            for k in range(begin, begin + count):
                if (k - begin) % LIVENESS_EVERY == 0:
                    live = active_blocks(lanes, m, BACKWARD_TRANSMITTANCE * STRIDE)
                ahead: Any = min(k + PREFETCH_AHEAD, begin + count - 1)
                prefetch_row(params, np.int64(gaussian_ids[ahead]))
                prefetch_row(intersections, np.int64(intersection_slots[ahead]))
                i = np.int64(gaussian_ids[k])
                slot = np.int64(intersection_slots[k])
                bits = np.uint64(masks[k]) & live
                sum_intersection_gradient(
                    lanes, depth, absolute, m, bits, params, i, origin_x, origin_y, _SUMS
                )
                _write_intersection(depth, absolute, m, _SUMS, params, i, intersections, slot)

    return backward_range


# -- Compiled reduction of per-intersection values of one band to the visible Gaussians -----------


@kernel(fast=False)
def add_intersection_gradients(
    begin: int, end: int, ids: np.ndarray, intersections: np.ndarray,
    intersection_offsets: np.ndarray, fresh: bool, grad_params: np.ndarray,
) -> None:  # fmt: skip
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
    begin: int, end: int, ids: np.ndarray, grad_params: np.ndarray, grad_px: np.ndarray,
    grad_abs_px: np.ndarray,
) -> None:  # fmt: skip
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
    begin: int, end: int, ids: np.ndarray, intersection_weights: np.ndarray,
    intersection_offsets: np.ndarray, weight_sum: np.ndarray, weight_max: np.ndarray,
) -> None:  # fmt: skip
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
    begin: int, end: int, ids: np.ndarray, boxes: np.ndarray, visible: np.ndarray,
    radii_px: np.ndarray,
) -> None:  # fmt: skip
    """Mark the Gaussians ``ids[begin .. end]`` visible; write half their boxes' longer side."""
    for k in range(begin, end):
        i = ids[k]
        visible[i] = True
        width, height = boxes[i, 2] - boxes[i, 0], boxes[i, 3] - boxes[i, 1]
        radii_px[i] = np.float32(0.5) * max(width, height)


# -- Compiled forward pass of tiles, front to back: nine feature channels, transmittance, depth
#
# The Gaussians of a tile are first listed for each block of pixels that their ellipses reach;
# each block is then blended with its state in registers, and its isosurface is solved from the
# entries that blending recorded, without evaluating any Gaussian again.


FORWARD_SCRATCH = FORWARD_PLANES * STRIDE + SOLVER_VALUES


@functools.cache
def forward_kernel(lanes: int, depth: bool, weights: bool) -> Any:
    """Return the blending kernel for blocks of 8 or 16 pixels, compiled on first call.

    ``depth`` also solves the isosurface; ``weights`` also collects the blending weights per
    intersection and the strongest Gaussian per pixel.
    """
    blocks = PLANE // lanes
    block_height = lanes // BLOCK_WIDTH

    @kernel(fast=True)
    def forward_range(
        first_tile: int, end_tile: int, params: np.ndarray, start: np.ndarray,
        gaussian_ids: np.ndarray, intersection_slots: np.ndarray, masks: np.ndarray, tiles_x: int,
        width: int, height: int, background: np.ndarray, limit: float, m: np.ndarray,
        lists: np.ndarray, contributors: np.ndarray, color: np.ndarray, normal: np.ndarray,
        geometric: np.ndarray, alpha_image: np.ndarray, depth_image: np.ndarray,
        slope_image: np.ndarray, intersection_weights: np.ndarray, strongest: np.ndarray,
    ) -> None:  # fmt: skip
        """Render tiles.

        ``lists`` and, for each block, ``contributors`` have room for the longest tile list.
        """
        longest: Any = 0
        for tile in range(first_tile, end_tile):
            longest = max(longest, np.int64(start[tile + 1]) - np.int64(start[tile]))
        capacity = longest + CONTRIBUTORS_PADDING
        counts = np.zeros(blocks, np.int64)
        nearest_depths = np.zeros(longest + 1, np.float32)
        images = (color, normal, geometric, alpha_image, depth_image, slope_image)
        for tile in range(first_tile, end_tile):
            begin = np.int64(start[tile])
            count = np.int64(start[tile + 1]) - begin
            tile_y = tile // tiles_x * TILE
            tile_x = tile % tiles_x * TILE
            origin_y = np.float32(tile_y) + HALF
            origin_x = np.float32(tile_x) + HALF
            live_rows = min(height - tile_y, TILE)
            live_columns = min(width - tile_x, TILE)
            # The rest of the scratch array is written before it is read.
            for p in range(PLANE):
                m[TRANSMITTANCE * STRIDE + p] = ONE
            if live_rows < TILE or live_columns < TILE:
                # Pixels outside the image start opaque, so nothing contributes to them.
                for row in range(TILE):
                    for column in range(0 if row >= live_rows else live_columns, TILE):
                        m[
                            TRANSMITTANCE * STRIDE
                            + (row // block_height * BLOCK_COLUMNS + column // BLOCK_WIDTH) * lanes
                            + row % block_height * BLOCK_WIDTH
                            + column % BLOCK_WIDTH
                        ] = ZERO
            for k in range(begin, begin + count):
                prefetch_row(params, np.int64(gaussian_ids[k]))
                if weights:
                    intersection_weights[intersection_slots[k], 0] = ZERO
                    intersection_weights[intersection_slots[k], 1] = ZERO
            coming: Any = np.int64(start[min(tile + 2, end_tile)]) - begin - count
            list_contributors(lanes, masks, begin, count, capacity, contributors, counts)
            if depth:
                # Back to front: the nearest depth that an intersection or any later one reaches.
                nearest: Any = FAR
                nearest_depths[0] = FAR
                for k in range(count - 1, -1, -1):
                    i = np.int64(gaussian_ids[begin + k])
                    nearest = min(nearest, params[i, 10] - FRONT_SIGMAS * params[i, 22])
                    nearest_depths[k] = nearest
            for block in range(blocks):
                # Prefetch the rows of the next tile while this one is blended.
                next_k = begin + count + block * coming // blocks
                for k in range(next_k, begin + count + (block + 1) * coming // blocks):
                    prefetch_row_early(params, np.int64(gaussian_ids[k]))
                entries = blend_block(
                    lanes, depth, weights, m, block, params, gaussian_ids, intersection_slots,
                    contributors, block * capacity, counts[block], begin, origin_x, origin_y,
                    lists, nearest_depths, limit, intersection_weights,
                )  # fmt: skip
                if depth:
                    solve_block(lanes, m, block * lanes, lists, entries)
            for row in range(live_rows):
                y = tile_y + row
                offset = (
                    row // block_height * BLOCK_COLUMNS * lanes + row % block_height * BLOCK_WIDTH
                )
                at = y * width + tile_x
                write_row(lanes, depth, m, offset, live_columns, background, images, at)
                if weights:
                    for column in range(live_columns):
                        b = offset + column // BLOCK_WIDTH * lanes + column % BLOCK_WIDTH
                        strongest[y, tile_x + column] = -1
                        if m[BEST * STRIDE + b] > ZERO:
                            strongest[y, tile_x + column] = gaussian_ids[
                                begin + np.int64(m[BEST_AT * STRIDE + b])
                            ]

    return forward_range


# -- Blend the tiles of a view, forward and backward: multithreaded raster kernels ----------------


_MOST_BLOCKS = 32
"""Blocks of a tile if a block has eight pixels."""


def _int32_zeros(count: int) -> np.ndarray:
    return np.zeros(count, np.int32)


def _take(pool: list[np.ndarray], count: int, make: Callable[[int], np.ndarray]) -> np.ndarray:
    """Return an array of at least ``count`` values from a pool, or a new, larger one."""
    try:
        kept = pool.pop()
        if len(kept) >= count:
            return kept
    except IndexError:
        pass
    return make(count * 5 // 4)


@dataclass
class RenderBuffers:
    """Pools of large scratch arrays, kept between calls.

    Taken and returned with the atomic ``list.pop`` and ``list.append``, so that concurrent
    renderings never share one.
    """

    scratch: list[np.ndarray] = field(default_factory=list)
    lists: list[np.ndarray] = field(default_factory=list)
    contributors: list[np.ndarray] = field(default_factory=list)
    renderers: list[Any] = field(default_factory=list)
    """Idle :class:`~.view_renderer.ViewRenderer` with their memory."""

    def reserve(self, threads: int, longest: int, *, depth: bool) -> None:
        """Allocate memory for every thread, so that allocation does not depend on timing.

        ``longest`` is the largest number of intersections of a tile; only depth needs lists.
        """
        for pool, array, make in (
            (self.scratch, self.take_scratch(), aligned_zeros),
            (self.lists, self.take_lists(longest if depth else 0), aligned_zeros),
            (self.contributors, self.take_contributors(longest), _int32_zeros),
        ):
            pool.append(array)
            while len(pool) < threads:
                pool.append(make(len(array)))

    def take_scratch(self) -> np.ndarray:
        """Return the uninitialised state of one thread's tile."""
        return _take(self.scratch, max(FORWARD_SCRATCH, BACKWARD_SCRATCH), aligned_zeros)

    def take_lists(self, longest: int) -> np.ndarray:
        """Return an uninitialised depth list for a block of a tile of ``longest`` intersections."""
        return _take(self.lists, longest * LIST_VALUES * TILE, aligned_zeros)

    def take_contributors(self, longest: int) -> np.ndarray:
        """Return uninitialised contributor lists for all blocks of such a tile."""
        count = _MOST_BLOCKS * (longest + CONTRIBUTORS_PADDING)
        return _take(self.contributors, count, _int32_zeros)


@dataclass(frozen=True)
class ScreenView:
    """One view, or a band of its tiles: state between projection and backward pass."""

    gaussians: RawArrays
    camera: Camera
    options: RenderOptions
    screen: ScreenGaussians
    lists: TileLists
    lanes: int
    masks: np.ndarray  # (intersections,) uint32: blocks of the tile that the ellipse reaches
    bounds: np.ndarray  # tiles of about equal cost
    threads: int

    def arguments(self) -> tuple[np.ndarray | int, ...]:
        """Return the view's arguments of the raster kernels, in order."""
        lists, camera = self.lists, self.camera
        return (
            self.screen.params, lists.start, lists.gaussian_ids, lists.intersection_slots,
            self.masks, lists.tiles_x, camera.width, camera.height,
        )  # fmt: skip


@dataclass(frozen=True)
class Images:
    """Images that the forward kernel writes, float32."""

    color: np.ndarray  # (h, w, 3)
    normal: np.ndarray  # (h, w, 3)
    geometric: np.ndarray  # (h, w, 3)
    alpha: np.ndarray  # (h, w)
    depth: np.ndarray  # (h, w)
    slope: np.ndarray  # (h, w) floored -d(log T)/dt at the depth; (0, 0) without depth
    strongest: np.ndarray  # (h, w) int32; (0, 0) without statistics

    @classmethod
    def allocate(
        cls,
        camera: Camera,
        options: RenderOptions,
        take: Callable[[str, tuple[int, ...], Any], np.ndarray] | None = None,
    ) -> Images:
        """Return zero images of the camera's size.

        With ``take(name, shape, dtype)`` they use the memory it returns; images of which
        :func:`blend` writes every pixel are not cleared then.
        """
        if take is None:

            def take(name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
                return np.zeros(shape, dtype)

        one, no_image = (camera.height, camera.width), (0, 0)
        three = (*one, 3)
        images = cls(
            color=take("color", three, np.float32), normal=take("normal", three, np.float32),
            geometric=take("geometric", three, np.float32), alpha=take("alpha", one, np.float32),
            depth=take("depth", one, np.float32),
            slope=take("slope", one if options.depth else no_image, np.float32),
            strongest=take("strongest", one if options.statistics else no_image, np.int32),
        )  # fmt: skip
        if not options.depth:
            images.depth.fill(0.0)
        return images

    def arguments(self) -> tuple[np.ndarray, ...]:
        """Return the images that both passes use, in the order of the raster kernels."""
        return self.color, self.normal, self.geometric, self.alpha, self.depth, self.slope


def blend(
    view: ScreenView,
    images: Images,
    buffers: RenderBuffers,
    intersection_weights: np.ndarray | None = None,
) -> np.ndarray:
    """Blend the tiles of a view into ``images`` and solve the isosurface depth.

    Returns (intersections, 2) float32, ``intersection_weights`` or a new array: sum and maximum of
    the blending weight of each intersection, by slot; (0, 2) without statistics.
    """
    options, lists = view.options, view.lists
    depth, weights = options.depth, options.statistics
    if intersection_weights is None:
        intersection_weights = np.zeros((len(lists.gaussian_ids) if weights else 0, 2), np.float32)
    forward = forward_kernel(view.lanes, depth, weights)
    background = np.asarray(options.background, np.float32)
    limit = np.float32(options.depth_valid_transmittance)
    longest = int(np.diff(lists.start).max(initial=0))
    buffers.reserve(view.threads, longest, depth=depth)

    def run(first: int, end: int) -> None:
        scratch = buffers.take_scratch()
        entries = buffers.take_lists(longest if depth else 0)
        contributors = buffers.take_contributors(longest)
        forward(
            first, end, *view.arguments(), background, limit, scratch, entries, contributors,
            *images.arguments(), intersection_weights, images.strongest,
        )  # fmt: skip
        buffers.scratch.append(scratch)
        buffers.lists.append(entries)
        buffers.contributors.append(contributors)

    run_chunks(run, view.bounds, view.threads)
    return intersection_weights


def write_intersection_gradients(
    view: ScreenView,
    images: Images,
    grads: list[np.ndarray],
    buffers: RenderBuffers,
    intersections: np.ndarray,
    *,
    depth: bool,
    absolute: bool,
) -> None:
    """Write the gradients of a view's tile intersections to their slots.

    ``intersections (p, 24)`` receives them. Set ``depth`` if the gradient of the depth is not all
    0, ``absolute`` to include the sums of absolute values.
    """
    backward = backward_kernel(view.lanes, view.options.depth and depth, absolute)

    def run(first: int, end: int) -> None:
        scratch = buffers.take_scratch()
        backward(
            first, end, *view.arguments(), *images.arguments(), *grads, scratch, intersections,
        )  # fmt: skip
        buffers.scratch.append(scratch)

    run_chunks(run, view.bounds, view.threads)
