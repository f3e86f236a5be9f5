# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses and optimiser as parts for ``benchmarks.iteration``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.mip_filter import mip_filter
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.training.losses import color_loss, normal_losses
from gaussian_wrapping_addon.core.training.optimizer import TRAINED, Adam


def training_parts(
    gaussians: OrientedGaussians, camera: Camera, threads: int
) -> list[tuple[str, Callable[[], object]]]:
    """Return the losses with their gradients, one Adam step of all rows, and the 3D filter."""
    with torch.no_grad():
        image = render(gaussians, camera, RenderOptions(threads=threads))
    noise = np.random.default_rng(0).normal(size=tuple(image.color.shape))
    photo = np.clip(255 * (image.color.numpy() + 0.1 * noise), 0, 255).astype(np.uint8)
    color = image.color.clone().requires_grad_()
    normal_inputs = [
        tensor.clone().requires_grad_()
        for tensor in (image.depth, image.geometric_normal, image.normal, image.alpha)
    ]
    adam = Adam(gaussians)
    gradients = {name: 1e-4 * torch.ones_like(adam.values[name]) for name in TRAINED}
    rates = {
        name: np.full(int(np.prod(adam.array(name).shape[1:])), 1e-12, np.float32)
        for name in TRAINED
    }
    everyone = np.ones(len(gaussians), bool)
    means = gaussians.means.numpy()

    def step() -> None:
        for name, gradient in gradients.items():
            adam.values[name].grad = gradient
        adam.step(rates, everyone, threads=threads)

    return [
        ("L1 + SSIM and gradient", lambda: color_loss(color, photo, threads=threads)[0].backward()),
        (
            "both normal losses, gradient",
            lambda: normal_losses(*normal_inputs, camera, threads=threads)[0].backward(),
        ),
        ("Adam, all Gaussians", step),
        ("3D filter, 50 cameras", lambda: mip_filter(means, [camera] * 50, threads=threads)),
    ]
