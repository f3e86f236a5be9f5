# SPDX-License-Identifier: GPL-3.0-or-later
"""The fast renderer on a GPU: the same images, depth, gradients and statistics as on the CPU.

No per-Gaussian or per-pixel data is copied to the host, except requested statistics.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...dataset.camera import Camera
from ...errors import UsageError
from ...gaussians.model import TRAINED, OrientedGaussians
from ..types.images import Render, RenderStatistics
from ..types.options import RenderOptions
from .device_view import IMAGES, DeviceView
from .kernels import Kernels, device_kernels

_BUDGET_SHARE = 0.5
"""Share of the free GPU memory used for tile intersections."""


def render_cuda(
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions | None = None,
    *,
    budget_bytes: int = 0,
) -> Render:
    """Render on the GPU that holds the Gaussians; see :func:`~.render.render`.

    Bitwise reproducible on the same GPU.

    Parameters
    ----------
    gaussians : OrientedGaussians
        CUDA tensors, float32, scene frame.
    camera : Camera
        In the scene frame.
    options : RenderOptions, optional
        ``threads`` and ``budget_bytes``, which is for the CPU's lists, are not used.
    budget_bytes : int
        GPU memory for tile intersections; 0 uses half of what is free.

    Raises
    ------
    UsageError
        If the tensors are not float32 or not on one GPU.
    DeviceError
        If the compiler or the driver is missing or fails.
    ResourceError
        If the GPU memory does not suffice.
    """
    device = gaussians.means.device
    if device.type != "cuda":
        raise UsageError("The Gaussians are not on a GPU.", "Use render() for CPU tensors.")
    index = device.index if device.index is not None else torch.cuda.current_device()
    budget = budget_bytes or free_budget_bytes(device)
    return render_with(device_kernels(index), gaussians, camera, options, budget)


def render_with(
    kernels: Kernels,
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions | None,
    budget_bytes: int,
) -> Render:
    """Render with the given kernels on the tensors' device; see :func:`render_cuda`."""
    options = options or RenderOptions()
    statistics = empty_statistics(len(gaussians), options) if options.gathers_statistics else None
    tensors = [getattr(gaussians, name) for name in TRAINED]
    images = _Rasterize.apply(
        *tensors, kernels, gaussians, camera, options, statistics, budget_bytes
    )
    color, normal, geometric, alpha, depth = images
    return Render(color, normal, geometric, alpha, depth, statistics)


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
        kernels: Kernels,
        gaussians: OrientedGaussians,
        camera: Camera,
        options: RenderOptions,
        statistics: RenderStatistics | None,
        budget_bytes: int,
    ) -> tuple[Tensor, ...]:
        view = DeviceView(kernels, gaussians.detached(), camera, options, budget_bytes)
        if statistics is not None:
            fill_statistics(statistics, view)
        ctx.set_materialize_grads(False)
        ctx.view, ctx.statistics = view, statistics
        outputs = tuple(getattr(view, name) for name in IMAGES)
        # Saved so that autograd refuses to run backward after one was modified in place.
        ctx.save_for_backward(means, log_scales, quats, opacity_logits, sh, orientation, *outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        ctx.saved_tensors  # noqa: B018 - raises where one was modified in place
        incoming = [None if grad is None else grad.detach().contiguous() for grad in grads]
        found = ctx.view.backward(incoming)
        if ctx.statistics is not None:
            measured = ctx.view.statistics
            ctx.statistics.grad_px[:] = measured.grad_px.cpu().numpy()
            ctx.statistics.grad_abs_px[:] = measured.grad_abs_px.cpu().numpy()
        return (*(found[name] for name in TRAINED), *[None] * 6)


def free_budget_bytes(device: torch.device) -> int:
    """Return the GPU memory that tile intersections may take now."""
    free, _ = torch.cuda.mem_get_info(device)
    # torch caches freed memory.
    kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return int(_BUDGET_SHARE * (free + kept))


def empty_statistics(count: int, options: RenderOptions) -> RenderStatistics:
    """Return statistics of zeros for ``count`` Gaussians."""
    weighed = count if options.statistics else 0
    return RenderStatistics(
        visible=np.zeros(count, np.bool_),
        radii_px=np.zeros(count, np.float32),
        weight_sum=np.zeros(weighed, np.float32),
        weight_max=np.zeros(weighed, np.float32),
        grad_px=np.zeros(count, np.float32),
        grad_abs_px=np.zeros(count, np.float32),
    )


def fill_statistics(statistics: RenderStatistics, view: DeviceView) -> None:
    """Copy to the host what the forward pass knows of each Gaussian."""
    measured = view.statistics
    statistics.visible = measured.reached.cpu().numpy()
    statistics.radii_px = view.radii_px().cpu().numpy()
    statistics.weight_sum = measured.weight_sum.cpu().numpy()
    statistics.weight_max = measured.weight_max.cpu().numpy()
    if view.images.strongest.numel():
        statistics.strongest = view.images.strongest.cpu().numpy()
