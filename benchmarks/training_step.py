# SPDX-License-Identifier: GPL-3.0-or-later
"""What training does around the raster kernels: a whole iteration, and the losses' gradients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.types.images import Render
from gaussian_wrapping_addon.core.training.losses.losses import color_loss, normal_losses

from .training_parts import Iteration


def noisy_photo(color: np.ndarray, seed: int) -> np.ndarray:
    """Return an 8-bit photo (h, w, 3) of a rendered image with noise of deviation 0.1."""
    noise = np.random.default_rng(seed).normal(scale=0.1, size=color.shape)
    return (255.0 * (color + noise).clip(0.0, 1.0)).astype(np.uint8)


def whole_iteration(
    gaussians: OrientedGaussians, camera: Camera, threads: int
) -> Callable[[], object]:
    """Return one training iteration without depth: render, L1 + SSIM, backward, Adam."""
    return Iteration(gaussians, camera, threads).run


def loss_gradients(
    out: Render, camera: Camera, photo: np.ndarray, dtype: torch.dtype
) -> dict[tuple[str, str], torch.Tensor]:
    """Return the hand-written gradients of the losses on the images, computed in ``dtype``."""
    image = out.color.detach().to(dtype).numpy()
    names = ("depth", "geometric_normal", "normal", "alpha")
    parts = [getattr(out, name).detach().to(dtype).numpy() for name in names]
    found = {("L1 + SSIM", "colour"): torch.from_numpy(color_loss(image, photo)[1])}
    by_normals = normal_losses(*parts, camera)[1]
    for name in names:
        gradient = getattr(by_normals, name)
        assert gradient is not None
        found["normal losses", name] = torch.from_numpy(gradient)
    return found
