# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth queries behind autograd, so that their gradients compare with the definition's."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.cuda import device_query
from gaussian_wrapping_addon.core.render.cuda.device_query import (
    DeviceQueryResult,
    project_query_gradients,
)
from gaussian_wrapping_addon.core.render.cuda.kernels import DeviceKernels, Kernels
from gaussian_wrapping_addon.core.render.depth_query import (
    add_query_gradients,
    query_view,
    solve_depths,
)
from gaussian_wrapping_addon.core.render.projection import RawArrays, RawGradients, project_backward
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera

_TRAINED = ("means", "log_scales", "quats", "opacity_logits")


def query_depth(
    gaussians: OrientedGaussians,
    camera: Camera,
    positions_px: Tensor,
    options: RenderOptions | None = None,
    kernels: Kernels | None = None,
) -> Tensor:
    """Return the depths (m,) at positions (m, 2), differentiable in both.

    With ``kernels`` those of the CUDA text, on a GPU or emulated.
    """
    tensors = [getattr(gaussians, name) for name in _TRAINED]
    given = (gaussians, camera, options or RenderOptions(), kernels)
    return _Query.apply(*tensors, positions_px, *given)


def slopes_of(depth: Tensor) -> np.ndarray:
    """Return the slopes (m,) of log T at depths of :func:`query_depth`."""
    result = depth.grad_fn.result  # type: ignore[union-attr]
    slopes = np.zeros(len(depth))
    if isinstance(result, DeviceQueryResult):
        slopes[result.points.order.cpu().numpy()] = result.slopes.cpu().numpy()
    else:
        slopes[result.positions.order] = result.slopes
    return slopes


class _Query(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Any) -> Tensor:
        positions, gaussians, camera, options, kernels = given[len(_TRAINED) :]
        ctx.dtype = positions.dtype
        if kernels is None:
            ctx.view = query_view(RawArrays.from_gaussians(gaussians), camera, options)
            ctx.result = solve_depths(ctx.view, positions.detach().numpy())
            return torch.from_numpy(ctx.result.values)
        device = "cuda" if isinstance(kernels, DeviceKernels) else "cpu"
        there = {name: tensor.detach().to(device) for name, tensor in gaussians.tensors()}
        ctx.view = device_query.query_view(kernels, OrientedGaussians(**there), camera, options)
        ctx.result = device_query.solve_depths(ctx.view, positions.detach().to(device))
        return ctx.result.values.cpu()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        view, result = ctx.view, ctx.result
        if isinstance(result, DeviceQueryResult):
            by_params = torch.zeros_like(view.screen.params)
            incoming = grad.detach().double().to(by_params.device)
            by_positions = device_query.add_query_gradients(view, result, incoming, by_params)
            assert not by_params[:, 13:].any()
            found = project_query_gradients(view, result, by_params)
            on_gaussians = [found[name].cpu() for name in _TRAINED]
            return (*on_gaussians, by_positions.cpu().to(ctx.dtype), None, None, None, None)
        grad_params = np.zeros_like(view.screen.params)
        on_positions = add_query_gradients(view, result, grad.detach().numpy(), grad_params)
        raw = RawGradients.zeros(view.gaussians)
        project_backward(view.gaussians, view.camera, view.options, view.screen, grad_params, raw)
        on_gaussians = [torch.from_numpy(getattr(raw, name)) for name in _TRAINED]
        on_positions = torch.from_numpy(on_positions).to(ctx.dtype)
        return (*on_gaussians, on_positions, None, None, None, None)
