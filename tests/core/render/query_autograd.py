# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth queries behind autograd, so that their gradients compare with the definition's."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
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
) -> Tensor:
    """Return the depths (m,) of ``solve_depths`` at positions (m, 2), differentiable in both."""
    tensors = [getattr(gaussians, name) for name in _TRAINED]
    return _Query.apply(*tensors, positions_px, gaussians, camera, options or RenderOptions())


class _Query(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Any) -> Tensor:
        positions, gaussians, camera, options = given[len(_TRAINED) :]
        view = query_view(RawArrays.from_gaussians(gaussians), camera, options)
        result = solve_depths(view, positions.detach().numpy())
        ctx.view, ctx.result, ctx.dtype = view, result, positions.dtype
        return torch.from_numpy(result.values)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        view = ctx.view
        grad_params = np.zeros_like(view.screen.params)
        on_positions = add_query_gradients(view, ctx.result, grad.detach().numpy(), grad_params)
        raw = RawGradients.zeros(view.gaussians)
        project_backward(view.gaussians, view.camera, view.options, view.screen, grad_params, raw)
        on_gaussians = [torch.from_numpy(getattr(raw, name)) for name in _TRAINED]
        return (*on_gaussians, torch.from_numpy(on_positions).to(ctx.dtype), None, None, None)
