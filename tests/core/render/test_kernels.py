# SPDX-License-Identifier: GPL-3.0-or-later
"""The fast renderer equals the definition in float64: images, depth, gradients, statistics."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render import reference, view_renderer
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.raster import Images, RenderBuffers, blend
from gaussian_wrapping_addon.core.render.reference import reference_projection, render_reference
from gaussian_wrapping_addon.core.render.render import project_view, render
from gaussian_wrapping_addon.core.render.types import ImageGradients, RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.comparisons import gradients_of, judge, leaves, narrowed, relative_l2
from tests.core.render.first_principles import IMAGES, TRAINED
from tests.core.render.scenes import look_at, random_gaussians

BACKGROUND = (0.2, 0.5, 0.1)


def depth_weights(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> torch.Tensor:
    """Return weights that make the depths' gradients comparable: their slopes of log T."""
    view = project_view(RawArrays.from_gaussians(gaussians), camera, options)
    images = Images.allocate(camera, options)
    blend(view, images, RenderBuffers())
    slope = np.where(images.depth > 0, images.slope, 0.0)
    typical = np.median(slope[slope > 0])
    return torch.from_numpy(np.where(slope > 0.05 * typical, slope / typical, 0.0)).double()


@pytest.mark.parametrize("lanes", [8, 16])
@pytest.mark.parametrize("size", [(60, 40, 30), (150, 33, 17), (25, 7, 5)])
def test_images_and_gradients_equal_the_definition(
    size: tuple[int, int, int], lanes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_renderer, "vector_lanes", lambda: lanes)
    count, width, height = size
    gaussians = random_gaussians(count, seed=count)
    camera = look_at((2.2, 1.0, 0.8), width=width, height=height, focal=1.1 * width)
    verdict = judge(gaussians, camera)
    verdict.assert_within(blended=2e-6, depth=5e-5, gradient=1e-4, depth_gradient=1e-4)
    assert verdict.depth_count > 5
    # Other kernels render without depths.
    random, options = np.random.default_rng(5), RenderOptions(depth=False, threads=2)
    weights = {name: random.normal(size=verdict.found[name].shape) for name in IMAGES[:4]}
    fast = gradients_of(render, narrowed(gaussians), camera, options, weights, torch.float32)
    exact = gradients_of(
        render_reference, narrowed(gaussians), camera, options, weights, torch.float64
    )
    for name in TRAINED:
        assert relative_l2(fast[name], exact[name]) < 1e-4, name


# -- statistics -----------------------------------------------------------------------------------


def weight_images(gaussians: OrientedGaussians, camera: Camera) -> torch.Tensor:
    """(n, h, w) blending weights: the images where one Gaussian is white and the others black."""
    images = []
    for i in range(len(gaussians)):
        sh = torch.full_like(gaussians.sh, 0.0)
        sh[:, 0] = -10.0
        sh[i, 0] = 0.5 / 0.28209479177387814
        images.append(render_reference(gaussians.replaced(sh=sh), camera, RenderOptions()).color)
    return torch.stack(images)[..., 0]


def test_weights_and_strongest_equal_the_definition() -> None:
    gaussians = random_gaussians(12, seed=4, sh_degree=0)
    camera = look_at((2.2, 1.0, 0.8), width=19, height=18, focal=25.0)
    weights = weight_images(gaussians, camera).numpy()
    with torch.no_grad():
        statistics = render(gaussians, camera, RenderOptions(statistics=True)).statistics
    assert statistics is not None
    assert np.allclose(statistics.weight_sum, weights.sum((1, 2)), rtol=1e-5, atol=1e-5)
    assert np.allclose(statistics.weight_max, weights.max((1, 2)), rtol=1e-5, atol=1e-6)
    assert np.array_equal(statistics.visible, weights.max((1, 2)) > 0)
    assert statistics.strongest is not None
    assert statistics.strongest.shape == (18, 19)
    best = weights.argmax(0)
    best[weights.max(0) == 0] = -1
    # Two equal weights may be ordered either way by rounding.
    ordered = np.sort(weights, 0)
    clear = (ordered[-1] - ordered[-2] > 1e-5) | (best == -1)
    assert clear.mean() > 0.95
    assert np.array_equal(statistics.strongest[clear], best[clear])


def test_screen_gradients_equal_the_definition() -> None:
    gaussians = random_gaussians(9, seed=6)
    camera = look_at((2.2, 1.0, 0.8), width=8, height=6, focal=9.0)
    options = RenderOptions(background=BACKGROUND, statistics=True, depth=False)
    flat = RenderOptions(background=BACKGROUND, depth=False)
    screen = reference_projection(gaussians, camera, flat)
    order = torch.argsort(screen.depths.float(), stable=True)
    params = screen.params.detach()[order].requires_grad_()
    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    image = reference._render_rows(params, background, camera, flat, 0, camera.height)[:, :3]
    weight = torch.linspace(-1.0, 2.0, image.numel(), dtype=torch.float64).reshape(image.shape)
    total = torch.zeros((9, 2), dtype=torch.float64)
    total_abs = torch.zeros((9, 2), dtype=torch.float64)
    for pixel in range(len(image)):
        (grad,) = torch.autograd.grad((image * weight)[pixel].sum(), params, retain_graph=True)
        total[order] += grad[:, :2]
        total_abs[order] += grad[:, :2].abs()

    out = render(leaves(gaussians, torch.float32), camera, options)
    (out.color * weight.reshape(out.color.shape)).sum().backward()
    assert out.statistics is not None
    assert np.allclose(out.statistics.grad_px, total.norm(dim=1).numpy(), rtol=1e-4, atol=1e-6)
    assert np.allclose(
        out.statistics.grad_abs_px, total_abs.norm(dim=1).numpy(), rtol=1e-4, atol=1e-6
    )


def test_gradients_of_params_equal_the_definition() -> None:
    gaussians = random_gaussians(20, seed=11)
    camera = look_at((2.2, 1.0, 0.8), width=20, height=18, focal=24.0)
    options = RenderOptions(background=BACKGROUND, threads=1)
    view = ViewRenderer().render(RawArrays.from_gaussians(gaussians), camera, options)
    order = np.argsort(view.screen.depths, kind="stable")
    params = torch.tensor(view.screen.params[order], dtype=torch.float64).requires_grad_()
    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    exact = reference._render_rows(params, background, camera, options, 0, camera.height)
    random = np.random.default_rng(1)
    weight = random.normal(size=exact.shape).astype(np.float32)  # (p, 11)
    weight[:, 10] *= depth_weights(gaussians, camera, options).numpy().reshape(-1)
    (exact * torch.from_numpy(weight).double()).sum().backward()
    split = np.split(weight.reshape(18, 20, 11), [3, 6, 9, 10], axis=2)
    incoming = [np.ascontiguousarray(part) for part in split[:3]]
    incoming += [np.ascontiguousarray(part[..., 0]) for part in split[3:]]
    found = np.zeros((20, 24), np.float32)
    found[view.ids] = view.params_gradient(ImageGradients(*incoming))[view.ids]
    assert params.grad is not None
    wanted = params.grad.numpy()
    for column in range(22):
        error = np.linalg.norm(found[order][:, column] - wanted[:, column])
        assert error < 2e-4 * np.linalg.norm(wanted[:, column]), column
    assert not found[:, 22:].any()


# -- edges of the interface ------------------------------------------------------------------------


def test_changed_outputs_are_refused_by_backward() -> None:
    leaf = leaves(random_gaussians(5, seed=1), torch.float32)
    out = render(leaf, look_at((2.2, 1.0, 0.8), width=16, height=16), RenderOptions())
    loss = out.color.sum()
    with torch.no_grad():
        out.color.mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
