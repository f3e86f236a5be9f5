# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare a rendering on the (emulated) GPU with the CPU kernels or the float64 definition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians
from gaussian_wrapping_addon.core.render.cuda.device_renderer import render_with
from gaussian_wrapping_addon.core.render.cuda.kernels import Kernels
from gaussian_wrapping_addon.core.render.types import Render, RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera

IMAGES = ("color", "normal", "geometric_normal", "alpha", "depth")
STATISTICS = ("visible", "radii_px", "weight_sum", "weight_max", "grad_px", "grad_abs_px")
BUDGET_BYTES = 1 << 30

Renderer = Callable[[OrientedGaussians, Camera, RenderOptions], Render]


def slope_of(view: Render) -> Tensor:
    """Return the slope of -log T at the depths, (h, w), of a rendering by the CUDA text."""
    slope = view.color.grad_fn.view.images.slope  # type: ignore[union-attr]
    assert isinstance(slope, Tensor)
    return slope


@dataclass(frozen=True)
class Outcome:
    """Images and gradients of one rendering; tensors on the CPU."""

    images: dict[str, Tensor]
    gradients: dict[str, Tensor]
    render: Render

    def values(self) -> list[Tensor]:
        """Return everything that must be reproduced."""
        found = [*self.images.values(), *self.gradients.values()]
        statistics = self.render.statistics
        if statistics is not None:
            found += [torch.as_tensor(getattr(statistics, name)) for name in STATISTICS]
            found.append(torch.as_tensor(statistics.strongest))
        return found


def emulated(kernels: Kernels, budget_bytes: int = BUDGET_BYTES) -> Renderer:
    """Return the renderer of the CUDA path with the given kernels."""
    return lambda gaussians, camera, options: render_with(
        kernels, gaussians, camera, options, budget_bytes
    )


def leaves(
    gaussians: OrientedGaussians, dtype: torch.dtype, device: str = "cpu"
) -> OrientedGaussians:
    """Return copies that collect gradients."""
    return gaussians.replaced(
        **{
            name: tensor.detach().to(device, dtype, copy=True).requires_grad_(name != "filter_3d")
            for name, tensor in gaussians.tensors()
        }
    )


def outcome(
    renderer: Renderer,
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions,
    *,
    weights: dict[str, Tensor],
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
) -> Outcome:
    """Render, and differentiate the images' sum weighed by ``weights``."""
    leaf = leaves(gaussians, dtype, device)
    out = renderer(leaf, camera, options)
    total = sum((getattr(out, n) * w.to(device, dtype)).sum() for n, w in weights.items())
    assert isinstance(total, Tensor)
    total.backward()
    return Outcome(
        {name: getattr(out, name).detach().cpu() for name in IMAGES},
        {name: getattr(leaf, name).grad.cpu() for name in TRAINED},
        out,
    )


def random_weights(camera: Camera, options: RenderOptions) -> dict[str, Tensor]:
    """Return a random linear functional of the images."""
    generator = torch.Generator().manual_seed(5)
    shape = (camera.height, camera.width)
    weights = {
        name: torch.randn((*shape, 3) if i < 3 else shape, generator=generator)
        for i, name in enumerate(IMAGES)
    }
    if not options.depth:
        del weights["depth"]
    return weights


def depth_weights(
    kernels: Kernels, gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> Tensor:
    """Return weights that make the depths' gradients comparable.

    A depth's gradient is something well conditioned over the slope of log T: each pixel is weighed
    by its slope, and pixels where T is all but flat at the crossing are left out.
    """
    leaf = leaves(gaussians, torch.float32, str(gaussians.means.device))
    view = emulated(kernels)(leaf, camera, options)
    slope = torch.where(view.depth.detach() > 0, slope_of(view), 0.0).cpu()
    if not (slope > 0).any():
        return slope
    typical = slope[slope > 0].median()
    return torch.where(slope > 0.05 * typical, slope / typical, 0.0)


def comparable_weights(
    kernels: Kernels, gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> dict[str, Tensor]:
    """Return random weights, that of the depth times :func:`depth_weights`."""
    weights = random_weights(camera, options)
    if options.depth:
        weights["depth"] *= depth_weights(kernels, gaussians, camera, options)
    return weights


def relative_l2(a: Tensor, b: Tensor) -> float:
    """Return |a - b| / |b|, or |a| where b is 0.

    Below the normal range of float32, as a saturated opacity's gradient, digits are lost: such a
    length counts as the end of that range.
    """
    scale = float(b.double().norm())
    scale = max(scale, float(torch.finfo(torch.float32).tiny)) if scale > 0.0 else 1.0
    return float((a.double() - b.double()).norm()) / scale


def assert_same_images(
    found: Outcome, wanted: Outcome, tolerance: float = 2e-6, *, decided: float = 0.0
) -> None:
    """Compare all images; depths where they exist to 1e-5, or in log T where that is flat.

    ``found`` is of the CUDA text. In a share ``decided`` of the pixels rounding may decide a
    threshold the other way: whether an alpha of 1/255 contributes, whether a transmittance of 0.45
    has a depth.
    """
    step = 2.0 * limits.ALPHA_MIN  # what a decision changes, times features up to 2
    for name in IMAGES[:4]:
        error = (found.images[name].double() - wanted.images[name].double()).abs()
        worst = error.flatten(2).amax(2) if error.dim() > 2 else error
        assert float((worst >= tolerance).double().mean()) <= decided, name
        assert float(worst.max()) < max(tolerance, step if decided else 0.0), name
    a, b = found.images["depth"].double(), wanted.images["depth"].double()
    assert float(((a > 0) != (b > 0)).double().mean()) <= decided
    both = (a > 0) & (b > 0)
    if not both.any():
        return
    error = ((a - b).abs() / b)[both]
    # Where T is nearly flat at the crossing, its rounding is magnified in the depth.
    residual = (a - b).abs()[both] * slope_of(found.render).cpu().double()[both]
    assert float((error >= 1e-5).double().mean()) < 0.01
    assert float(((error >= 1e-5) & (residual >= 1e-5)).double().mean()) <= decided
    assert float(torch.minimum(error, residual).max()) < (step if decided else 5e-5)


def assert_same_gradients(found: Outcome, wanted: Outcome, tolerance: float = 1e-4) -> None:
    """Compare the gradients of every parameter group in the L2 norm."""
    for name in TRAINED:
        error = relative_l2(found.gradients[name], wanted.gradients[name])
        assert error < tolerance, f"{name}: {error}"


def assert_same_statistics(found: Outcome, cpu: Outcome) -> None:
    """Compare what was asked for."""
    a, b = found.render.statistics, cpu.render.statistics
    assert a is not None
    assert b is not None
    assert np.array_equal(a.visible, b.visible)
    assert np.allclose(a.radii_px, b.radii_px, rtol=1e-6)
    for name in ("weight_sum", "weight_max", "grad_px", "grad_abs_px"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        assert np.abs(x - y).max(initial=0.0) <= 1e-4 * np.abs(y).max(initial=0.0), name
    assert (a.strongest is None) == (b.strongest is None)
    if a.strongest is not None and b.strongest is not None:
        assert a.strongest.dtype == b.strongest.dtype
        # Two equal weights may be ordered either way by rounding.
        assert (a.strongest == b.strongest).mean() > 0.99


def assert_bitwise_equal(found: Outcome, wanted: Outcome) -> None:
    """Compare images, gradients and statistics bit by bit."""
    for a, b in zip(found.values(), wanted.values(), strict=True):
        assert torch.equal(a, b)
