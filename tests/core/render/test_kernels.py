# SPDX-License-Identifier: GPL-3.0-or-later
"""The fast renderer equals the definition in float64: images, depth, gradients, statistics."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render import reference, simd, view_renderer
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.raster import Images, RenderBuffers, blend
from gaussian_wrapping_addon.core.render.reference import reference_projection, render_reference
from gaussian_wrapping_addon.core.render.render import project_view, render
from gaussian_wrapping_addon.core.render.types import ImageGradients, Render, RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.comparisons import leaves, relative_l2
from tests.core.render.first_principles import IMAGES, TRAINED
from tests.core.render.scenes import isotropic, look_at, random_gaussians

BACKGROUND = (0.2, 0.5, 0.1)


def depth_weights(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> torch.Tensor:
    """Return weights that make the depths' gradients comparable.

    A depth's gradient is something well conditioned over the slope of log T: each pixel is weighed
    by its slope, and pixels where T is all but flat at the crossing are left out.
    """
    view = project_view(RawArrays.from_gaussians(gaussians), camera, options)
    images = Images.allocate(camera, options)
    blend(view, images, RenderBuffers())
    slope = np.where(images.depth > 0, images.slope, 0.0)
    typical = np.median(slope[slope > 0])
    return torch.from_numpy(np.where(slope > 0.05 * typical, slope / typical, 0.0)).double()


def both_losses(
    fast: Render, exact: Render, depth_weight: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the same random linear functional of both renderings."""
    generator = torch.Generator().manual_seed(5)
    sums = [torch.zeros(()), torch.zeros((), dtype=torch.float64)]
    for name in IMAGES:
        a, b = getattr(fast, name), getattr(exact, name)
        weight = torch.randn(b.shape, generator=generator, dtype=torch.float64)
        if name == "depth":
            if depth_weight is None:
                continue
            weight = weight * depth_weight * (a > 0) * (b > 0)
        sums[0] = sums[0] + (a.double() * weight).sum()
        sums[1] = sums[1] + (b * weight).sum()
    return sums[0], sums[1]


@pytest.mark.parametrize("lanes", [8, 16])
@pytest.mark.parametrize(
    ("count", "width", "height"), [(60, 40, 30), (150, 33, 17), (40, 16, 16), (25, 7, 5)]
)
def test_images_equal_the_definition(
    count: int, width: int, height: int, lanes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_renderer, "vector_lanes", lambda: lanes)
    gaussians = random_gaussians(count, seed=count, dtype=torch.float32)
    camera = look_at((2.2, 1.0, 0.8), width=width, height=height, focal=1.1 * width)
    options = RenderOptions(background=BACKGROUND, threads=1)
    with torch.no_grad():
        fast = render(gaussians, camera, options)
        exact = render_reference(
            gaussians.replaced(**{k: v.double() for k, v in gaussians.tensors()}), camera, options
        )
    for name in IMAGES[:4]:
        assert (getattr(fast, name).double() - getattr(exact, name)).abs().max() < 2e-6, name
    assert torch.equal(fast.depth > 0, exact.depth > 0)
    found = exact.depth > 0
    error = ((fast.depth.double() - exact.depth).abs() / exact.depth)[found]
    # Where T is nearly flat at the crossing, its rounding is magnified in the depth.
    assert float((error > 1e-5).double().mean()) < 0.01
    assert float(error.max()) < 5e-5


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("lanes", [8, 16])
def test_gradients_equal_the_definition(
    depth: bool, lanes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_renderer, "vector_lanes", lambda: lanes)
    gaussians = random_gaussians(70, seed=3, dtype=torch.float32)
    camera = look_at((2.2, 1.0, 0.8), width=41, height=27)
    options = RenderOptions(depth=depth, background=BACKGROUND, threads=2)
    one, two = leaves(gaussians, torch.float32), leaves(gaussians, torch.float64)
    weight = depth_weights(gaussians, camera, options) if depth else None
    fast, exact = both_losses(
        render(one, camera, options), render_reference(two, camera, options), weight
    )
    fast.backward()
    exact.backward()
    for name in TRAINED:
        assert relative_l2(getattr(one, name).grad, getattr(two, name).grad) < 1e-4, name


def test_depth_gradient_alone_equals_the_definition() -> None:
    gaussians = random_gaussians(50, seed=8, dtype=torch.float32, opacity=(0.3, 0.97))
    camera = look_at((2.2, 1.0, 0.8), width=24, height=20)
    options = RenderOptions(threads=1)
    weight = depth_weights(gaussians, camera, options)
    one, two = leaves(gaussians, torch.float32), leaves(gaussians, torch.float64)
    fast, exact = render(one, camera, options).depth, render_reference(two, camera, options).depth
    assert int((exact > 0).sum()) > 100
    (fast.double() * weight).sum().backward()
    (exact * weight).sum().backward()
    for name in ("means", "log_scales", "quats", "opacity_logits"):
        assert relative_l2(getattr(one, name).grad, getattr(two, name).grad) < 1e-4, name


def test_bitwise_the_same_for_any_number_of_threads() -> None:
    gaussians = random_gaussians(400, seed=2, dtype=torch.float32, scale=(0.02, 0.15))
    camera = look_at((2.2, 1.0, 0.8), width=70, height=50, focal=80.0)
    results = []
    for threads in (1, 2, 3):
        leaf = leaves(gaussians, torch.float32)
        out = render(leaf, camera, RenderOptions(threads=threads, statistics=True))
        sum((getattr(out, name) ** 2).sum() for name in IMAGES).backward()
        statistics = out.statistics
        assert statistics is not None
        results.append(
            [getattr(out, name).detach().numpy() for name in IMAGES]
            + [getattr(leaf, name).grad.numpy() for name in TRAINED]
            + [statistics.weight_sum, statistics.grad_px, statistics.grad_abs_px]
        )
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert np.array_equal(a, b)


def test_identical_depths_keep_the_order_of_indices() -> None:
    means = [(0.0, 0.0, 0.0)] * 6
    gaussians = isotropic(means, [0.3] * 6, [0.5] * 6, torch.float32)
    sh = torch.zeros((6, 1, 3))
    sh[:, 0, 0] = torch.linspace(-1.0, 1.5, 6)
    gaussians = gaussians.replaced(sh=sh)
    camera = look_at((0.0, -3.0, 0.0), width=20, height=20, focal=30.0)
    fast = render(gaussians, camera, RenderOptions(threads=2))
    exact = render_reference(gaussians, camera, RenderOptions())
    assert (fast.color - exact.color).abs().max() < 5e-6


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


def test_nothing_visible_gives_the_background_and_zero_gradients() -> None:
    gaussians = isotropic([(0.0, 9.0, 0.0)], [0.1], [0.9], torch.float32)
    camera = look_at((0.0, 3.0, 0.0), width=18, height=10)  # looks away
    for some in (gaussians, gaussians.select(torch.zeros(1, dtype=torch.bool))):
        leaf = leaves(some, torch.float32)
        out = render(leaf, camera, RenderOptions(background=BACKGROUND, statistics=True))
        assert torch.allclose(out.color, torch.tensor(BACKGROUND).expand(10, 18, 3))
        assert not out.alpha.any()
        assert not out.depth.any()
        (out.color.sum() + out.alpha.sum() + out.depth.sum()).backward()
        assert leaf.means.grad is not None
        assert not leaf.means.grad.any()
        assert out.statistics is not None
        assert out.statistics.strongest is not None
        assert (out.statistics.strongest == -1).all()


def test_changed_outputs_are_refused_by_backward() -> None:
    leaf = leaves(random_gaussians(5, seed=1), torch.float32)
    out = render(leaf, look_at((2.2, 1.0, 0.8), width=16, height=16), RenderOptions())
    loss = out.color.sum()
    with torch.no_grad():
        out.color.mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_two_views_before_one_backward() -> None:
    gaussians = random_gaussians(30, seed=12)
    cameras = [look_at((2.2, 1.0, 0.8), width=20, height=20), look_at((-2.0, 1.4, 0.3))]
    buffers = RenderBuffers()
    together = leaves(gaussians, torch.float32)
    outs = [render(together, camera, buffers=buffers) for camera in cameras]
    sum(out.color.square().sum() for out in outs).backward()
    apart = torch.zeros_like(gaussians.means, dtype=torch.float32)
    for camera in cameras:
        leaf = leaves(gaussians, torch.float32)
        render(leaf, camera, buffers=buffers).color.square().sum().backward()
        apart += leaf.means.grad
    assert torch.allclose(together.means.grad, apart, rtol=1e-5, atol=1e-6)


def test_exponentials_are_as_exact_as_stated() -> None:
    x = np.linspace(0.0, 5.6, 4001).astype(np.float32)
    short = np.array([simd.exp_short(value) for value in x])
    assert np.abs(short / np.exp(-x.astype(np.float64)) - 1.0).max() < 2.5e-6
    assert simd.exp_short(np.float32(1e9)) < 1.0 / 255.0
    x = np.linspace(0.0, 22.4, 4001).astype(np.float32)
    wide = np.array([simd.exp_wide(value) for value in x])
    assert np.abs(wide / np.exp(-x.astype(np.float64)) - 1.0).max() < 8e-6
    assert simd.exp_wide(np.float32(0.0)) == 1.0
