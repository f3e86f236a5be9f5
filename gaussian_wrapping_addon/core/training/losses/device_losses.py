# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses on images of a device: those of :mod:`.losses` and :mod:`.depth_prior_loss` as kernels.

Values and their gradients stay on the device; nothing is read back.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ... import tolerances
from ...dataset.camera import Camera
from ...render.cuda.kernels import CameraValues, Kernels
from ...render.cuda.source import THREADS_PER_BLOCK
from ...render.types.gradients import ImageGradients

_CAMERA_VALUES = 22


def device_color_loss(
    kernels: Kernels,
    image: Tensor,
    photo: Tensor,
    mask: Tensor | None,
    *,
    lambda_dssim: float,
    counts: tuple[int, int],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return loss, gradient on the image and mean squared error; see :func:`~.losses.color_loss`.

    Parameters
    ----------
    image, photo : (h, w, 3) float32
        Contiguous, white is 1.
    mask : (h, w) bool, optional
    counts : (int, int)
        Pixels, and windows of SSIM centred on pixels, that the mask leaves.

    Returns
    -------
    loss, mean_squared : 0-dim float32
    gradient : (h, w, 3) float32
    """
    height, width = image.shape[:2]
    pixels, windows = counts
    if windows == 0:
        lambda_dssim = 0.0
    tiles_x, tiles_y = (-(-side // tolerances.TILE_PX) for side in (width, height))
    tiles = tiles_x * tiles_y
    masked = mask if mask is not None else image.new_empty(0, dtype=torch.bool)
    size = (masked, int(mask is not None), width, height, tiles_x)
    similar = lambda_dssim > 0.0
    maps = image.new_empty((3, 3, height, width) if similar else (0,))
    ssim: Tensor | float = 1.0
    if similar:
        sums = image.new_empty((tiles, 3))
        kernels.launch("ssim_maps", tiles, image, photo, *size, maps, sums)
        ssim = sums.sum() / (3 * windows)
    gradient, sums = torch.empty_like(image), image.new_empty((tiles, 2))
    values = 3 * max(1, pixels)
    kernels.launch(
        "color_gradient",
        tiles,
        image,
        photo,
        *size,
        maps,
        int(similar),
        (1.0 - lambda_dssim) / values,
        -lambda_dssim / max(1, 3 * windows),
        gradient,
        sums,
    )
    absolute, squared = (sums.sum(0) / values).unbind()
    return (1.0 - lambda_dssim) * absolute + lambda_dssim * (1.0 - ssim), gradient, squared


def device_normal_losses(
    kernels: Kernels,
    depth: Tensor,
    geometric_normal: Tensor,
    normal: Tensor,
    alpha: Tensor,
    camera: Camera,
    mask: Tensor | None,
    *,
    lambda_depth_normal: float,
    lambda_normal: float,
    pixels: int,
) -> tuple[Tensor, ImageGradients]:
    """Return the weighted sum of both normal losses and its gradients on the four images.

    See :func:`~.losses.normal_losses`; ``pixels`` is the number that the mask leaves.
    """
    height, width = depth.shape
    count = height * width
    packed = np.concatenate([camera.rotation.reshape(-1), _lens(camera)])
    blocks = -(-count // THREADS_PER_BLOCK)
    by_geometric, by_learned = torch.empty_like(geometric_normal), torch.empty_like(normal)
    by_alpha, by_depth = torch.empty_like(alpha), torch.empty_like(depth)
    spread, sums = depth.new_empty((4, height, width)), depth.new_empty((blocks, 3))
    kernels.launch_each(
        "agree_normals",
        count,
        width,
        height,
        depth,
        alpha,
        geometric_normal,
        normal,
        mask if mask is not None else depth.new_empty(0, dtype=torch.bool),
        int(mask is not None),
        _packed(packed),
        lambda_depth_normal / max(1, pixels),
        lambda_normal / max(1, pixels),
        by_geometric,
        by_learned,
        by_alpha,
        spread,
        sums,
    )
    kernels.launch_each("gather_depth", count, width, height, spread, by_depth)
    geometric, learned, _ = (sums.sum(0) / max(1, pixels)).unbind()
    gradients = ImageGradients(
        normal=by_learned, geometric_normal=by_geometric, alpha=by_alpha, depth=by_depth
    )
    return lambda_depth_normal * geometric + lambda_normal * learned, gradients


def device_prior_loss(
    kernels: Kernels,
    depth: Tensor,
    camera: Camera,
    prior: tuple[Tensor, Tensor, Camera],
    mask: Tensor | None,
    *,
    weight: float,
    pixels: int,
) -> tuple[Tensor, ImageGradients]:
    """Return the loss on depths that leave the confirmed ones, and its gradient on the depth.

    Parameters
    ----------
    prior : (tensor, tensor, Camera)
        Confirmed depths (h', w') and their confidences, float32, and their camera; see
        :func:`~.depth_prior_loss.depth_prior_loss`.
    """
    confirmed, confidence, prior_camera = prior
    height, width = depth.shape
    by_depth = torch.zeros_like(depth)
    blocks = -(-height * width // THREADS_PER_BLOCK)
    sums = depth.new_empty(blocks)
    kernels.launch_each(
        "prior_depths",
        height * width,
        width,
        depth,
        confirmed,
        confidence,
        int(confirmed.shape[1]),
        int(confirmed.shape[0]),
        mask if mask is not None else depth.new_empty(0, dtype=torch.bool),
        int(mask is not None),
        _packed(np.concatenate([_lens(camera), _lens(prior_camera)])),
        weight / max(1, pixels),
        by_depth,
        sums,
    )
    return sums.sum(), ImageGradients(depth=by_depth)


def _lens(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


def _packed(values: np.ndarray) -> CameraValues:
    padded = np.zeros(_CAMERA_VALUES)
    padded[: len(values)] = values
    return CameraValues.of(padded)
