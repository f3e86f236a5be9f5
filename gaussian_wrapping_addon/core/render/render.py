# SPDX-License-Identifier: GPL-3.0-or-later
"""The fast renderer: Gaussians and a camera in, images and their gradients out, on the CPU."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..dataset.camera import Camera
from ..errors import ResourceError
from ..gaussians.model import OrientedGaussians
from ..parallel import CHUNKS_PER_THREAD, balanced_bounds, default_threads, even_bounds, run_chunks
from .isosurface import LIST_VALUES
from .pair_rows import narrow_rows
from .projection import (
    RawArrays,
    RawGradients,
    ScreenGaussians,
    project_backward,
    project_gaussians,
)
from .raster_backward import BACKWARD_SCRATCH, backward_kernel, sum_pairs, sum_weights
from .raster_forward import FORWARD_SCRATCH, forward_kernel
from .raster_math import PLANE, ROW_VALUES, aligned_zeros, vector_lanes
from .tiles import TileLists, bin_gaussians
from .types import Render, RenderOptions, RenderStatistics

_TRAINED = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
# What a tile costs besides its pairs, in pairs: clearing and writing its pixels.
_TILE_COST = 16
# Contributors per pixel that the lists of one thread first have room for, and at most. One less
# than a power of two, so that the lists of different runs do not compete for the same cache sets.
_FIRST_SLOTS = 127
_MAX_SLOTS = 1 << 20


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

    def take_lists(self) -> np.ndarray:
        """Return contributor lists for one thread, with any content."""
        try:
            return self.lists.pop()
        except IndexError:
            return aligned_zeros(_FIRST_SLOTS * LIST_VALUES * PLANE)

    def take_pairs(self, count: int) -> np.ndarray:
        """Return at least ``count`` rows of pair gradients with any content."""
        try:
            kept = self.pairs.pop()
        except IndexError:
            kept = np.zeros((0, ROW_VALUES), np.float32)
        return kept if len(kept) >= count else np.zeros((count * 5 // 4, ROW_VALUES), np.float32)


@functools.cache
def _shared_buffers() -> RenderBuffers:
    return RenderBuffers()


@dataclass(frozen=True)
class _View:
    """One view between forward and backward."""

    gaussians: RawArrays
    camera: Camera
    options: RenderOptions
    screen: ScreenGaussians
    lists: TileLists
    rows: np.ndarray  # (pairs, 2) uint8
    bounds: np.ndarray  # tiles of about equal cost
    threads: int


@dataclass(frozen=True)
class _Images:
    """What the forward kernel writes, image layout, float32."""

    color: np.ndarray  # (h, w, 3)
    normal: np.ndarray  # (h, w, 3)
    geometric: np.ndarray  # (h, w, 3)
    alpha: np.ndarray  # (h, w)
    depth: np.ndarray  # (h, w)
    slope: np.ndarray  # (h, w) floored -d(log T)/dt at the depth; (0, 0) without depth
    pair_weights: np.ndarray  # (pairs, 2) sum and maximum of alpha T; (0, 2) without statistics
    strongest: np.ndarray  # (h, w) int32; (0, 0) without statistics


def render(
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions | None = None,
    buffers: RenderBuffers | None = None,
) -> Render:
    """Render by the definition of :func:`~.reference.render_reference`, in float32 (kernels.md 4).

    Differentiable with respect to every tensor of ``gaussians`` except ``filter_3d``. Images and
    gradients are bitwise the same for any number of threads.

    Parameters
    ----------
    gaussians : OrientedGaussians
        CPU tensors, scene frame.
    camera : Camera
        In the scene frame; any image size.
    options : RenderOptions, optional
    buffers : RenderBuffers, optional
        Scratch to reuse; by default one set is shared by the process.

    Returns
    -------
    Render
        float32 images. With ``options.statistics`` the weights are filled at once, ``grad_px`` and
        ``grad_abs_px`` when ``backward`` runs.

    Raises
    ------
    ResourceError
        If the tile lists or the contributor lists grow beyond what can be addressed.
    """
    options = options or RenderOptions()
    collected = _empty_statistics(len(gaussians)) if options.statistics else None
    tensors = [getattr(gaussians, name) for name in _TRAINED]
    images = _Rasterize.apply(
        *tensors, gaussians, camera, options, collected, buffers or _shared_buffers()
    )
    color, normal, geometric, alpha, depth = images
    return Render(color, normal, geometric, alpha, depth, collected)


class _Rasterize(torch.autograd.Function):
    """Projection, binning and blending as one differentiable step."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        opacity_logits: Tensor,
        sh: Tensor,
        orientation: Tensor,
        gaussians: OrientedGaussians,
        camera: Camera,
        options: RenderOptions,
        statistics: RenderStatistics | None,
        buffers: RenderBuffers,
    ) -> tuple[Tensor, ...]:
        view = project_view(RawArrays.from_gaussians(gaussians), camera, options)
        images = blend(view, buffers)
        if statistics is not None:
            _fill_statistics(statistics, view, images)
        ctx.view, ctx.images, ctx.statistics, ctx.buffers = view, images, statistics, buffers
        outputs = tuple(
            torch.from_numpy(image)
            for image in (
                images.color,
                images.normal,
                images.geometric,
                images.alpha,
                images.depth,
            )
        )
        # The backward pass reads their memory; saved, so that autograd refuses to run it after
        # one of them was changed in place.
        ctx.save_for_backward(means, log_scales, quats, opacity_logits, sh, orientation, *outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        view, statistics = ctx.view, ctx.statistics
        incoming = [np.ascontiguousarray(grad.detach().numpy(), np.float32) for grad in grads]
        grad_params, grad_px, grad_abs_px = blend_backward(
            view, ctx.images, incoming, ctx.buffers, absolute=statistics is not None
        )
        if statistics is not None:
            statistics.grad_px[:] = grad_px
            statistics.grad_abs_px[:] = grad_abs_px
        raw = RawGradients.zeros(view.gaussians)
        project_backward(view.gaussians, view.camera, view.options, view.screen, grad_params, raw)
        return (*(torch.from_numpy(getattr(raw, name)) for name in _TRAINED), *[None] * 5)


def project_view(gaussians: RawArrays, camera: Camera, options: RenderOptions) -> _View:
    """Project and bin: everything of a view that comes before the pixels."""
    threads = options.threads or default_threads()
    screen = project_gaussians(gaussians, camera, options)
    lists = bin_gaussians(screen, camera.width, camera.height, threads)
    rows = np.zeros((len(lists.gaussian_ids), 2), np.uint8)
    bounds = balanced_bounds(np.diff(lists.start) + _TILE_COST, threads * CHUNKS_PER_THREAD)

    def narrow(first: int, end: int) -> None:
        narrow_rows(
            first,
            end,
            lists.start,
            lists.gaussian_ids,
            lists.pixel_ranges,
            screen.boxes,
            screen.skews,
            lists.tiles_x,
            rows,
        )

    run_chunks(narrow, bounds, threads)
    return _View(gaussians, camera, options, screen, lists, rows, bounds, threads)


def blend(view: _View, buffers: RenderBuffers) -> _Images:
    """Blend all tiles of a view and solve their isosurface depth."""
    options, lists, camera = view.options, view.lists, view.camera
    height, width = camera.height, camera.width
    depth, weights = options.depth, options.statistics
    no_image = (0, 0)
    images = _Images(
        color=np.zeros((height, width, 3), np.float32),
        normal=np.zeros((height, width, 3), np.float32),
        geometric=np.zeros((height, width, 3), np.float32),
        alpha=np.zeros((height, width), np.float32),
        depth=np.zeros((height, width), np.float32),
        slope=np.zeros((height, width) if depth else no_image, np.float32),
        pair_weights=np.zeros((len(lists.gaussian_ids) if weights else 0, 2), np.float32),
        strongest=np.zeros((height, width) if weights else no_image, np.int32),
    )
    lanes = vector_lanes()
    forward = forward_kernel(lanes, depth, weights)
    background = np.asarray(options.background, np.float32)
    limit = np.float32(options.depth_valid_transmittance)

    def run(first: int, end: int) -> None:
        scratch, contributors = buffers.take_scratch(), buffers.take_lists()
        while True:
            first = forward(
                first,
                end,
                view.screen.params,
                lists.start,
                lists.gaussian_ids,
                lists.pair_slots,
                lists.pixel_ranges,
                view.rows,
                lists.tiles_x,
                width,
                height,
                background,
                limit,
                scratch,
                contributors,
                images.color,
                images.normal,
                images.geometric,
                images.alpha,
                images.depth,
                images.slope,
                images.pair_weights,
                images.strongest,
            )
            if first >= end:
                break
            slots = 2 * (len(contributors) // (LIST_VALUES * PLANE)) + 1
            if slots > _MAX_SLOTS:
                raise ResourceError(
                    f"A pixel of view {camera.name!r} sees over {_MAX_SLOTS // 2} Gaussians.",
                    "Use fewer Gaussians.",
                )
            contributors = aligned_zeros(slots * LIST_VALUES * PLANE)
        buffers.scratch.append(scratch)
        buffers.lists.append(contributors)

    run_chunks(run, view.bounds, view.threads)
    return images


def blend_backward(
    view: _View,
    images: _Images,
    grads: list[np.ndarray],
    buffers: RenderBuffers,
    *,
    absolute: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the gradient on params (n, 24), and its length on (u, v) plain and absolute (n,)."""
    lists, camera = view.lists, view.camera
    count = len(view.screen)
    g_color, g_normal, g_geometric, g_alpha, g_depth = grads
    backward = backward_kernel(vector_lanes(), view.options.depth and bool(g_depth.any()), absolute)
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
            lists.pixel_ranges,
            view.rows,
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


def _empty_statistics(count: int) -> RenderStatistics:
    return RenderStatistics(
        visible=np.zeros(count, np.bool_),
        radii_px=np.zeros(count, np.float32),
        weight_sum=np.zeros(count, np.float32),
        weight_max=np.zeros(count, np.float32),
        grad_px=np.zeros(count, np.float32),
        grad_abs_px=np.zeros(count, np.float32),
    )


def _fill_statistics(statistics: RenderStatistics, view: _View, images: _Images) -> None:
    boxes = view.screen.boxes
    offsets = view.lists.pair_offsets
    statistics.visible = np.diff(offsets) > 0
    sides = np.maximum(boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1])  # (n,)
    statistics.radii_px = np.where(statistics.visible, 0.5 * sides, 0.0).astype(np.float32)
    statistics.strongest = images.strongest

    def combine(first: int, end: int) -> None:
        sum_weights(
            first,
            end,
            images.pair_weights,
            offsets,
            statistics.weight_sum,
            statistics.weight_max,
        )

    run_chunks(combine, even_bounds(len(view.screen), view.threads), view.threads)
