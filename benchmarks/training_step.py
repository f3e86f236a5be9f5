# SPDX-License-Identifier: GPL-3.0-or-later
"""What training does around the raster kernels: a whole iteration, and the losses' gradients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.blend import RenderBuffers
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import Render, RenderOptions
from gaussian_wrapping_addon.core.training.losses import color_loss, normal_losses
from gaussian_wrapping_addon.core.training.optimizer import TRAINED, Adam

_RATE = 1e-12
"""So small that the scene stays what it is, however often an iteration is repeated."""


def noisy_photo(color: np.ndarray, seed: int) -> np.ndarray:
    """Return an 8-bit photo (h, w, 3) of a rendered image with noise of deviation 0.1."""
    noise = np.random.default_rng(seed).normal(scale=0.1, size=color.shape)
    return (255.0 * (color + noise).clip(0.0, 1.0)).astype(np.uint8)


def whole_iteration(
    gaussians: OrientedGaussians, camera: Camera, threads: int
) -> Callable[[], object]:
    """Return one training iteration without depth: render, L1 + SSIM, backward, Adam."""
    options = RenderOptions(depth=False, threads=threads)
    buffers, adam = RenderBuffers(), Adam(gaussians)
    with torch.no_grad():
        photo = noisy_photo(render(gaussians, camera, options, buffers).color.numpy(), 0)
    rates = {
        name: np.full(int(np.prod(adam.array(name).shape[1:])), _RATE, np.float32)
        for name in TRAINED
    }

    def iteration() -> None:
        out = render(adam.gaussians(), camera, options, buffers)
        loss, _ = color_loss(out.color, photo, threads=threads)
        loss.backward()
        moved = adam.values["opacity_logits"].grad
        assert moved is not None
        adam.step(rates, (moved != 0).numpy(), threads=threads)

    return iteration


def loss_gradients(
    out: Render, camera: Camera, photo: np.ndarray, dtype: torch.dtype
) -> dict[tuple[str, str], torch.Tensor]:
    """Return the hand-written gradients of the losses on the images, computed in ``dtype``."""
    image = out.color.detach().to(dtype).requires_grad_()
    names = ("depth", "geometric_normal", "normal", "alpha")
    parts = [getattr(out, name).detach().to(dtype).requires_grad_() for name in names]
    found = {
        ("L1 + SSIM", "colour"): torch.autograd.grad(color_loss(image, photo)[0], [image])[0],
    }
    by_normals = torch.autograd.grad(normal_losses(*parts, camera)[0], parts)
    for name, gradient in zip(names, by_normals, strict=True):
        found["normal losses", name] = gradient
    return found
