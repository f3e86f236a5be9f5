# SPDX-License-Identifier: GPL-3.0-or-later
"""Differentiable rendering of Gaussians: the fast renderer behind a torch autograd function."""

from __future__ import annotations

import dataclasses
import functools
import weakref
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..gaussians.model import TRAINED, OrientedGaussians
from ..parallel import ArrayStore, default_threads
from ..scene.camera import Camera
from .cuda.device_renderer import render_cuda
from .projection import RawArrays, RawGradients, project_backward, project_gaussians
from .raster import Images, RenderBuffers, ScreenView
from .tiles import TileBinning
from .types import ImageGradients, Render, RenderOptions, RenderStatistics
from .view_renderer import ViewPass, ViewRenderer, allocate_screen, band_view


@functools.cache
def _shared_buffers() -> RenderBuffers:
    return RenderBuffers()


def render(
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions | None = None,
    buffers: RenderBuffers | None = None,
) -> Render:
    """Render as defined by :func:`~.reference.render_reference`, in float32.

    Differentiable with respect to every tensor of ``gaussians`` (scene frame) except ``filter_3d``.
    Images and gradients are bitwise the same for any number of threads. Float32 CUDA tensors are
    rendered on the GPU. ``buffers`` is scratch memory to reuse; by default one set is shared by the
    process. With ``options.statistics`` the weights are filled at once, ``grad_px`` and
    ``grad_abs_px`` by the backward pass.

    Raises
    ------
    ResourceError
        If the tile lists or the contributor lists grow beyond what can be addressed.
    DeviceError
        If the Gaussians are on a GPU that the compiler or driver does not support.
    """
    if gaussians.means.is_cuda:
        return render_cuda(gaussians, camera, options)
    options = options or RenderOptions()
    collected: list[RenderStatistics] = []
    tensors = [getattr(gaussians, name) for name in TRAINED]
    images = _Rasterize.apply(
        *tensors, gaussians, camera, options, collected, buffers or _shared_buffers()
    )
    color, normal, geometric, alpha, depth = images
    return Render(color, normal, geometric, alpha, depth, collected[0] if collected else None)


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
        collected: list[RenderStatistics],
        buffers: RenderBuffers,
    ) -> tuple[Tensor, ...]:
        images = Images.allocate(camera, options)
        view = _render_view(RawArrays.from_gaussians(gaussians), camera, options, images, buffers)
        if view.statistics is not None:
            collected.append(_copy_statistics(view.statistics))
        ctx.view, ctx.collected = view, collected
        ctx.camera, ctx.options = camera, options
        ctx.set_materialize_grads(False)
        outputs = tuple(torch.from_numpy(image) for image in images.arguments()[:5])
        # The backward pass reads their memory; saved so that autograd refuses to run after one of
        # them was modified in place.
        ctx.save_for_backward(means, log_scales, quats, opacity_logits, sh, orientation, *outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        view: ViewPass = ctx.view
        incoming = [None if grad is None else grad.detach().numpy() for grad in grads]
        grad_params = view.params_gradient(ImageGradients(*incoming))
        if view.statistics is not None:
            ctx.collected[0].grad_px[:] = view.statistics.grad_px
            ctx.collected[0].grad_abs_px[:] = view.statistics.grad_abs_px
        gaussians = view.gaussians
        seen = np.zeros(len(gaussians), np.bool_)
        seen[view.ids] = True
        screen = dataclasses.replace(view.screen, visible=seen)
        raw = RawGradients.zeros(gaussians)
        project_backward(gaussians, ctx.camera, ctx.options, screen, grad_params, raw)
        return (*(torch.from_numpy(getattr(raw, name)) for name in TRAINED), *[None] * 5)


def _render_view(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    images: Images,
    buffers: RenderBuffers,
) -> ViewPass:
    """Render with an idle renderer, which is returned to the pool with the view."""
    try:
        renderer = buffers.renderers.pop()
    except IndexError:
        renderer = ViewRenderer(RenderBuffers(buffers.scratch, buffers.lists))
    view = renderer.render(gaussians, camera, options, images)
    weakref.finalize(view, buffers.renderers.append, renderer).atexit = False
    return view


def _copy_statistics(statistics: RenderStatistics) -> RenderStatistics:
    """Return a copy that stays valid when the renderer's memory is reused."""
    copies = {
        item.name: getattr(statistics, item.name).copy()
        for item in dataclasses.fields(statistics)
        if item.name != "strongest"
    }
    return dataclasses.replace(statistics, **copies)


def project_view(gaussians: RawArrays, camera: Camera, options: RenderOptions) -> ScreenView:
    """Project and bin: everything of a view that precedes rasterisation."""
    threads, store = options.threads or default_threads(), ArrayStore()
    screen = project_gaussians(gaussians, camera, options, allocate_screen(len(gaussians), store))
    binning = TileBinning(screen, camera.width, camera.height, threads, store)
    band = (0, binning.tiles_x * binning.tiles_y)
    return band_view(gaussians, camera, options, screen, binning.lists(*band), band, store)
