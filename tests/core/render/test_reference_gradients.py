# SPDX-License-Identifier: GPL-3.0-or-later
"""Autograd of the reference against central differences, away from every threshold."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import _cast, render_reference
from gaussian_wrapping_addon.core.render.reference_projection import reference_projection
from gaussian_wrapping_addon.core.render.types import Render, RenderOptions
from tests.core.render.scenes import look_at, random_gaussians

NAMES = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
CAMERA = look_at((2.6, 0.4, 0.5), width=3, height=2, focal=9.0)
OPTIONS = RenderOptions(background=(0.3, 0.1, 0.2))


def scene() -> OrientedGaussians:
    """Four Gaussians that all reach every pixel, none of them capped."""
    gaussians = random_gaussians(
        4, 11, sh_degree=2, spread=0.25, scale=(0.35, 0.7), opacity=(0.5, 0.9), filter_size=0.05
    )
    screen = reference_projection(gaussians, CAMERA, OPTIONS)
    grid_y, grid_x = torch.meshgrid(torch.arange(2) + 0.5, torch.arange(3) + 0.5, indexing="ij")
    hits = _cast(screen.params, grid_x.double().reshape(-1), grid_y.double().reshape(-1))
    alpha = hits.log_alpha.exp()
    assert screen.usable.all()
    assert alpha.min() > 2.0 / 255.0
    assert alpha.max() < 0.98
    assert hits.final.min() > 1e-3
    assert hits.final.max() < 0.4
    distance = screen.depths.sort().values
    assert (distance[1:] - distance[:-1]).min() > 1e-3
    return gaussians


def check(pick: Callable[[Render], Tensor], name: str) -> None:
    gaussians = scene()

    def image(value: Tensor) -> Tensor:
        return pick(render_reference(gaussians.replaced(**{name: value}), CAMERA, OPTIONS))

    value = getattr(gaussians, name).clone().requires_grad_()
    assert torch.autograd.gradcheck(image, (value,), eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_blended_images(name: str) -> None:
    check(
        lambda view: torch.cat(
            [view.color, view.normal, view.geometric_normal, view.alpha[..., None]], 2
        ),
        name,
    )


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logits"])
def test_isosurface_depth(name: str) -> None:
    check(lambda view: view.depth, name)


@pytest.mark.parametrize("name", NAMES)
def test_projection_columns(name: str) -> None:
    gaussians = random_gaussians(3, 8, sh_degree=3)
    scale = reference_projection(gaussians, CAMERA, OPTIONS).params.abs().amax(0) + 1e-3

    def columns(value: Tensor) -> Tensor:
        screen = reference_projection(gaussians.replaced(**{name: value}), CAMERA, OPTIONS)
        return screen.params / scale

    value = getattr(gaussians, name).clone().requires_grad_()
    assert torch.autograd.gradcheck(columns, (value,), eps=1e-6, atol=1e-7, rtol=1e-5)


def test_filter_gets_no_gradient_and_gradients_stay_finite_off_screen() -> None:
    gaussians = random_gaussians(20, 3)
    quats = gaussians.quats.clone()
    quats[0] = 0.0
    means = gaussians.means.clone()
    means[1] = torch.tensor([5.0, 0.0, 0.0])  # behind the camera
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in gaussians.tensors()}
    leaves |= {"quats": quats.requires_grad_(), "means": means.requires_grad_()}
    leaves["filter_3d"] = gaussians.filter_3d
    view = render_reference(OrientedGaussians(**leaves), look_at((2.0, 0.1, 0.2)), RenderOptions())
    (view.color.sum() + view.normal.sum() + view.depth.sum() + view.alpha.sum()).backward()
    for name in NAMES:
        gradient = leaves[name].grad
        assert gradient is not None
        assert torch.isfinite(gradient).all(), name
        assert not gradient[1].any(), name
        assert gradient.any(), name
    assert not leaves["quats"].grad[0].any()  # type: ignore[index]
