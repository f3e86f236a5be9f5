# SPDX-License-Identifier: GPL-3.0-or-later
"""Blending the tiles of a view, forward and backward: the raster kernels over threads."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..dataset.camera import Camera
from ..parallel import even_bounds, run_chunks
from .isosurface_steps import LIST_VALUES
from .projection import RawArrays, ScreenGaussians
from .raster_backward import BACKWARD_SCRATCH, backward_kernel, sum_pairs
from .raster_forward import FORWARD_SCRATCH, forward_kernel
from .raster_math import ROW_VALUES, TILE, aligned_zeros
from .tiles import TileLists
from .types import RenderOptions


@dataclass
class RenderBuffers:
    """Large scratch arrays kept from call to call.

    Taken and given back with the atomic ``list.pop`` and ``list.append``, so renderings in several
    threads never share one.
    """

    scratch: list[np.ndarray] = field(default_factory=list)
    lists: list[np.ndarray] = field(default_factory=list)
    pairs: list[np.ndarray] = field(default_factory=list)

    def take_scratch(self) -> np.ndarray:
        """Return the state of one thread's tile, with any content."""
        try:
            return self.scratch.pop()
        except IndexError:
            return aligned_zeros(max(FORWARD_SCRATCH, BACKWARD_SCRATCH))

    def take_lists(self, entries: int) -> np.ndarray:
        """Return room for the list of a block of one thread, with any content."""
        values = entries * LIST_VALUES * TILE
        try:
            kept = self.lists.pop()
        except IndexError:
            kept = aligned_zeros(0)
        return kept if len(kept) >= values else aligned_zeros(values * 5 // 4)

    def take_pairs(self, count: int) -> np.ndarray:
        """Return at least ``count`` rows of pair gradients with any content."""
        try:
            kept = self.pairs.pop()
        except IndexError:
            kept = np.zeros((0, ROW_VALUES), np.float32)
        return kept if len(kept) >= count else np.zeros((count * 5 // 4, ROW_VALUES), np.float32)


@dataclass(frozen=True)
class ScreenView:
    """One view, or a part of its tiles, between projection and gradient."""

    gaussians: RawArrays
    camera: Camera
    options: RenderOptions
    screen: ScreenGaussians
    lists: TileLists
    lanes: int
    masks: np.ndarray  # (pairs,) uint32: blocks of the tile that the ellipse reaches
    bounds: np.ndarray  # tiles of about equal cost
    threads: int


@dataclass(frozen=True)
class Images:
    """What the forward kernel writes, image layout, float32."""

    color: np.ndarray  # (h, w, 3)
    normal: np.ndarray  # (h, w, 3)
    geometric: np.ndarray  # (h, w, 3)
    alpha: np.ndarray  # (h, w)
    depth: np.ndarray  # (h, w)
    slope: np.ndarray  # (h, w) floored -d(log T)/dt at the depth; (0, 0) without depth
    strongest: np.ndarray  # (h, w) int32; (0, 0) without statistics

    @classmethod
    def allocate(cls, camera: Camera, options: RenderOptions) -> Images:
        """Return images of the camera's size, all 0."""
        height, width = camera.height, camera.width
        no_image = (0, 0)
        return cls(
            color=np.zeros((height, width, 3), np.float32),
            normal=np.zeros((height, width, 3), np.float32),
            geometric=np.zeros((height, width, 3), np.float32),
            alpha=np.zeros((height, width), np.float32),
            depth=np.zeros((height, width), np.float32),
            slope=np.zeros((height, width) if options.depth else no_image, np.float32),
            strongest=np.zeros((height, width) if options.statistics else no_image, np.int32),
        )


def blend(view: ScreenView, images: Images, buffers: RenderBuffers) -> np.ndarray:
    """Blend the tiles of a view into ``images`` and solve their isosurface depth.

    Returns
    -------
    (pairs, 2) float32
        Sum and maximum of the blending weight of each pair, by slot; (0, 2) without statistics.
    """
    options, lists, camera = view.options, view.lists, view.camera
    depth, weights = options.depth, options.statistics
    pair_weights = np.zeros((len(lists.gaussian_ids) if weights else 0, 2), np.float32)
    forward = forward_kernel(view.lanes, depth, weights)
    background = np.asarray(options.background, np.float32)
    limit = np.float32(options.depth_valid_transmittance)

    def run(first: int, end: int) -> None:
        scratch = buffers.take_scratch()
        longest = int((lists.start[first + 1 : end + 1] - lists.start[first:end]).max())
        entries = buffers.take_lists(longest if depth else 0)
        forward(
            first,
            end,
            view.screen.params,
            lists.start,
            lists.gaussian_ids,
            lists.pair_slots,
            view.masks,
            lists.tiles_x,
            camera.width,
            camera.height,
            background,
            limit,
            scratch,
            entries,
            images.color,
            images.normal,
            images.geometric,
            images.alpha,
            images.depth,
            images.slope,
            pair_weights,
            images.strongest,
        )
        buffers.scratch.append(scratch)
        buffers.lists.append(entries)

    run_chunks(run, view.bounds, view.threads)
    return pair_weights


def blend_backward(
    view: ScreenView,
    images: Images,
    grads: list[np.ndarray],
    buffers: RenderBuffers,
    *,
    absolute: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the gradient on params (n, 24), and its length on (u, v) plain and absolute (n,)."""
    lists, camera = view.lists, view.camera
    count = len(view.screen)
    g_color, g_normal, g_geometric, g_alpha, g_depth = grads
    backward = backward_kernel(view.lanes, view.options.depth and bool(g_depth.any()), absolute)
    pairs = buffers.take_pairs(len(lists.gaussian_ids))

    def run(first: int, end: int) -> None:
        scratch = buffers.take_scratch()
        backward(
            first,
            end,
            view.screen.params,
            lists.start,
            lists.gaussian_ids,
            lists.pair_slots,
            view.masks,
            lists.tiles_x,
            camera.width,
            camera.height,
            images.color,
            images.normal,
            images.geometric,
            images.alpha,
            images.depth,
            images.slope,
            g_color,
            g_normal,
            g_geometric,
            g_alpha,
            g_depth,
            scratch,
            pairs,
        )
        buffers.scratch.append(scratch)

    run_chunks(run, view.bounds, view.threads)
    grad_params = np.zeros((count, ROW_VALUES), np.float32)
    grad_px = np.zeros(count, np.float32)
    grad_abs_px = np.zeros(count, np.float32)

    def combine(first: int, end: int) -> None:
        sum_pairs(first, end, pairs, lists.pair_offsets, grad_params, grad_px, grad_abs_px)

    run_chunks(combine, even_bounds(count, view.threads), view.threads)
    buffers.pairs.append(pairs)
    return grad_params, grad_px, grad_abs_px
