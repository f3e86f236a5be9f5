# SPDX-License-Identifier: GPL-3.0-or-later
"""The fast renderer: Gaussians and a camera in, images and their gradients out, on the CPU."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..dataset.camera import Camera
from ..gaussians.model import OrientedGaussians
from ..parallel import CHUNKS_PER_THREAD, balanced_bounds, default_threads, even_bounds, run_chunks
from .blend import Images, RenderBuffers, ScreenView, blend, blend_backward
from .block_masks import mask_kernel
from .projection import (
    RawArrays,
    RawGradients,
    project_backward,
    project_gaussians,
)
from .raster_backward import sum_weights
from .raster_math import vector_lanes
from .tiles import bin_gaussians
from .types import Render, RenderOptions, RenderStatistics

_TRAINED = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
# What a tile costs besides its pairs, in pairs: clearing and writing its pixels.
_TILE_COST = 16


@functools.cache
def _shared_buffers() -> RenderBuffers:
    return RenderBuffers()


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
        images = Images.allocate(camera, options)
        pair_weights = blend(view, images, buffers)
        if statistics is not None:
            _fill_statistics(statistics, view, images, pair_weights)
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


def project_view(gaussians: RawArrays, camera: Camera, options: RenderOptions) -> ScreenView:
    """Project and bin: everything of a view that comes before the pixels."""
    threads = options.threads or default_threads()
    screen = project_gaussians(gaussians, camera, options)
    lists = bin_gaussians(screen, camera.width, camera.height, threads)
    masks = np.zeros(len(lists.gaussian_ids), np.uint32)
    bounds = balanced_bounds(np.diff(lists.start) + _TILE_COST, threads * CHUNKS_PER_THREAD)
    lanes = vector_lanes()
    mask_range = mask_kernel(lanes)

    def mark(first: int, end: int) -> None:
        mask_range(
            first,
            end,
            lists.start,
            lists.gaussian_ids,
            screen.boxes,
            screen.skews,
            lists.tiles_x,
            masks,
        )

    run_chunks(mark, bounds, threads)
    return ScreenView(gaussians, camera, options, screen, lists, lanes, masks, bounds, threads)


def _empty_statistics(count: int) -> RenderStatistics:
    return RenderStatistics(
        visible=np.zeros(count, np.bool_),
        radii_px=np.zeros(count, np.float32),
        weight_sum=np.zeros(count, np.float32),
        weight_max=np.zeros(count, np.float32),
        grad_px=np.zeros(count, np.float32),
        grad_abs_px=np.zeros(count, np.float32),
    )


def _fill_statistics(
    statistics: RenderStatistics, view: ScreenView, images: Images, pair_weights: np.ndarray
) -> None:
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
            pair_weights,
            offsets,
            statistics.weight_sum,
            statistics.weight_max,
        )

    run_chunks(combine, even_bounds(len(view.screen), view.threads), view.threads)
