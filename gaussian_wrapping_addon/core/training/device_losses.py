# SPDX-License-Identifier: GPL-3.0-or-later
"""All losses on a GPU."""

from __future__ import annotations

import ctypes
import dataclasses

import numpy as np
import torch
from torch import Tensor

from .. import limits
from ..gaussians.model import OrientedGaussians
from ..render.cuda.device_query import (
    add_query_gradients,
    project_query_gradients,
    query_view,
    solve_depths,
)
from ..render.cuda.device_view import WARPS, DeviceView
from ..render.cuda.kernels import THREADS_PER_BLOCK, CameraValues, Kernels
from ..render.projection import pack_camera
from ..render.types import ImageGradients, RenderOptions
from ..resampling import LUMA
from ..scene.camera import Camera
from .losses import lens_of
from .multi_view import (
    BLOCK_PX,
    BORDER_PX,
    MultiViewLoss,
    MultiViewMetrics,
    MultiViewOptions,
    PhotoView,
)
from .multi_view_kernels import KEPT, SAMPLES

# -- Losses on images of a device: those of :mod:`.losses` and :mod:`.losses` as kernels
#
# Values and their gradients stay on the device; nothing is read back.

_CAMERA_VALUES = 22


def device_color_loss(
    kernels: Kernels, image: Tensor, photo: Tensor, mask: Tensor | None, *, lambda_dssim: float,
    counts: tuple[int, int],
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
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
    tiles_x, tiles_y = (-(-side // limits.TILE_PX) for side in (width, height))
    tiles = tiles_x * tiles_y
    size = (*_masked(mask, image), width, height, tiles_x)
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
        "color_gradient", tiles, image, photo, *size, maps, int(similar),
        (1.0 - lambda_dssim) / values, -lambda_dssim / max(1, 3 * windows), gradient, sums,
    )  # fmt: skip
    absolute, squared = (sums.sum(0) / values).unbind()
    return (1.0 - lambda_dssim) * absolute + lambda_dssim * (1.0 - ssim), gradient, squared


def device_normal_losses(
    kernels: Kernels, depth: Tensor, geometric_normal: Tensor, normal: Tensor, alpha: Tensor,
    camera: Camera, mask: Tensor | None, *, lambda_depth_normal: float, lambda_normal: float,
    pixels: int,
) -> tuple[Tensor, ImageGradients]:  # fmt: skip
    """Return the weighted sum of both normal losses and its gradients on the four images.

    See :func:`~.losses.normal_losses`; ``pixels`` is the number that the mask leaves.
    """
    height, width = depth.shape
    count = height * width
    packed = np.concatenate([camera.rotation.reshape(-1), lens_of(camera)])
    blocks = -(-count // THREADS_PER_BLOCK)
    by_geometric, by_learned = torch.empty_like(geometric_normal), torch.empty_like(normal)
    by_alpha, by_depth = torch.empty_like(alpha), torch.empty_like(depth)
    spread, sums = depth.new_empty((4, height, width)), depth.new_empty((blocks, 3))
    kernels.launch_each(
        "agree_normals", count, width, height, depth, alpha, geometric_normal, normal,
        *_masked(mask, depth),
        _packed(packed), lambda_depth_normal / max(1, pixels), lambda_normal / max(1, pixels),
        by_geometric, by_learned, by_alpha, spread, sums,
    )  # fmt: skip
    kernels.launch_each("gather_depth", count, width, height, spread, by_depth)
    geometric, learned, _ = (sums.sum(0) / max(1, pixels)).unbind()
    gradients = ImageGradients(
        normal=by_learned, geometric_normal=by_geometric, alpha=by_alpha, depth=by_depth
    )
    return lambda_depth_normal * geometric + lambda_normal * learned, gradients


def device_prior_loss(
    kernels: Kernels, depth: Tensor, camera: Camera, prior: tuple[Tensor, Tensor, Camera],
    mask: Tensor | None, *, weight: float, pixels: int,
) -> tuple[Tensor, ImageGradients]:  # fmt: skip
    """Return the loss on depths that leave the confirmed ones, and its gradient on the depth.

    Parameters
    ----------
    prior : (tensor, tensor, Camera)
        Confirmed depths (h', w') and their confidences, float32, and their camera; see
        :func:`~.losses.depth_prior_loss`.
    """
    confirmed, confidence, prior_camera = prior
    height, width = depth.shape
    by_depth = torch.zeros_like(depth)
    blocks = -(-height * width // THREADS_PER_BLOCK)
    sums = depth.new_empty(blocks)
    kernels.launch_each(
        "prior_depths", height * width, width, depth, confirmed, confidence,
        int(confirmed.shape[1]), int(confirmed.shape[0]),
        *_masked(mask, depth),
        _packed(np.concatenate([lens_of(camera), lens_of(prior_camera)])), weight / max(1, pixels),
        by_depth, sums,
    )  # fmt: skip
    return sums.sum(), ImageGradients(depth=by_depth)


def _masked(mask: Tensor | None, like: Tensor) -> tuple[Tensor, int]:
    """Return a mask as kernels take it, and whether there is one."""
    return (like.new_empty(0, dtype=torch.bool), 0) if mask is None else (mask, 1)


def _packed(values: np.ndarray) -> CameraValues:
    padded = np.zeros(_CAMERA_VALUES)
    padded[: len(values)] = values
    return CameraValues.of(padded)


# -- The multi-view losses of :mod:`.multi_view` on a GPU, as tensors -----------------------------
#
# Arrays of sampled pixels have a fixed length, and what excludes pixels are factors: the only
# number that the host waits for is that of the tile intersections of the depth query.


def device_multi_view_losses(
    kernels: Kernels, images: DeviceView, gaussians: OrientedGaussians, shown: PhotoView,
    other: PhotoView, settings: MultiViewOptions, random: np.random.Generator,
) -> MultiViewLoss:  # fmt: skip
    """Compare a rendered view with the photo and the depth of another view, on a device.

    The definition, the sampled pixels and the numbers drawn are those of
    :func:`~.multi_view.multi_view_losses`. Bitwise reproducible on the same GPU.

    Raises
    ------
    ResourceError
        If the tile lists are too long to be indexed.
    """
    options = RenderOptions(sh_degree=0)
    grey, other_grey = (grey_on_device(kernels, view.photo) for view in (shown, other))
    # A null pointer is no mask.
    none = torch.empty(0, dtype=torch.bool, device=shown.photo.device)
    our_mask, their_mask = (
        none if view.mask is None else view.mask.contiguous() for view in (shown, other)
    )
    depth = images.depth.detach().contiguous()
    normals = images.geometric_normal.detach().contiguous()
    alpha = images.alpha.detach().contiguous()
    pixels = choose_on_device(kernels, grey, depth, our_mask, settings.pixels, random)
    pair = _Pair(kernels, pixels, shown.camera, other.camera, options.near_z)
    positions, position_slopes = pair.lift(depth, their_mask)
    view = query_view(kernels, gaussians, other.camera, options)
    depths = solve_depths(view, positions)
    noise, weights, by_found, by_positions = pair.reproject(positions, depths.values)
    states, errors, depth_slopes, normal_slopes = pair.compare(
        noise, (depth, normals, alpha), (grey, other_grey), (our_mask, their_mask), settings
    )
    kept, valid = states == KEPT, noise < np.inf  # (m,)
    counts = torch.stack([kept.sum(), valid.sum()])
    sums = torch.stack(
        [(weights * errors).sum(), (weights * torch.where(valid, noise, 0.0)).sum()]
    )  # errors are 0 where no patch is kept, weights where a pixel is not valid
    means = sums / counts.clamp(min=1)
    lambdas = (settings.lambda_photometric, settings.lambda_geometric)
    factors = [settings.weight * value for value in lambdas]
    shares = torch.stack(
        [factor / count for factor, count in zip(factors, counts.clamp(min=1), strict=True)]
    ).double()  # (2,)
    on_other = None
    if factors[1] != 0.0:
        grad_params = torch.zeros_like(view.screen.params)  # (n, 24)
        incoming = shares[1] * weights * by_found
        on_positions = add_query_gradients(view, depths, incoming, grad_params)
        on_other = project_query_gradients(view, depths, grad_params)
    else:
        on_positions = torch.zeros_like(positions)
    gradients = ImageGradients(
        depth=torch.zeros_like(depth), geometric_normal=torch.zeros_like(normals)
    )
    kernels.launch_each(
        "finish_pixels", len(pixels), pixels, depth, normals, weights, shares, depth_slopes,
        normal_slopes, by_positions, on_positions, position_slopes, gradients.depth,
        gradients.geometric_normal,
    )  # fmt: skip
    figures = MultiViewMetrics(means[0], means[1], (pixels >= 0).sum(), counts[1], counts[0])
    value = factors[0] * means[0] + factors[1] * means[1]
    return MultiViewLoss(value, gradients, on_other, figures)


def grey_on_device(kernels: Kernels, photo: Tensor) -> Tensor:
    """Return (h, w) float32 grey in [0, 1] of an (h, w, 3) uint8 photo."""
    photo = photo.contiguous()
    grey = torch.empty(photo.shape[:2], device=photo.device)
    shares = [share * (1.0 / 255.0) for share in LUMA]
    kernels.launch_each("grey_pixels", grey.numel(), photo, *shares, grey)
    return grey


def choose_on_device(
    kernels: Kernels, grey: Tensor, depth: Tensor, mask: Tensor, count: int,
    random: np.random.Generator,
) -> Tensor:  # fmt: skip
    """Sample the pixels of :func:`~.multi_view.choose_pixels`, with the same random numbers.

    ``mask`` is (h, w) bool, or (0,) for none. Returns (m,) int32, ``row * width + column`` or -1; m
    is ``count`` or, if smaller, the number of pixels.
    """
    height, width = grey.shape
    takes_all = count >= grey.numel()
    drawn = torch.from_numpy(random.random(0 if takes_all else count))
    jitter = drawn.to(grey.device, non_blocking=True)
    # One block is the whole image, row by row.
    block = max(height, width) if takes_all else BLOCK_PX
    steepness = torch.empty(grey.numel(), device=grey.device)  # by place
    kernels.launch_each(
        "measure_pixels", grey.numel(), width, height, block, BORDER_PX, grey, depth, mask,
        steepness,
    )  # fmt: skip
    usable = steepness >= 0.0
    if takes_all:
        places = torch.arange(len(steepness), dtype=torch.int32, device=grey.device)
        return torch.where(usable, places, -1)
    wide = torch.where(usable, steepness.double(), 0.0)
    steep, number = wide.sum(), usable.sum()
    even = torch.where(steep > 0.0, steep / number.clamp(min=1), 1.0)
    running = torch.where(usable, wide + even, 0.0).cumsum(0)
    total = steep + even * number
    pixels = torch.empty(count, dtype=torch.int32, device=grey.device)
    kernels.launch_each("pick_pixels", count, width, height, block, jitter, running, total, pixels)
    return pixels


class _Pair:
    """Two views and the sampled pixels of the first, packed for the kernels."""

    def __init__(
        self, kernels: Kernels, pixels: Tensor, camera: Camera, other: Camera, near_z: float
    ) -> None:
        self.kernels, self.pixels, self.width = kernels, pixels, camera.width
        turn = other.rotation @ camera.rotation.T  # (3, 3) other camera from this one
        shift = other.cam_from_world[:, 3] - turn @ camera.cam_from_world[:, 3]
        pose = np.concatenate([turn, shift[:, None]], 1)  # (3, 4)
        self.camera = CameraValues.of(pack_camera(camera, near_z))
        relative = dataclasses.replace(other, cam_from_world=pose)
        self.pair = CameraValues.of(pack_camera(relative, near_z))

    def lift(self, depth: Tensor, other_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions in the other view (m, 2) float32, and their derivatives by depth."""
        positions = depth.new_empty((len(self.pixels), 2))
        slopes = torch.empty_like(positions, dtype=torch.float64)
        self.kernels.launch_each(
            "lift_points", len(self.pixels), self.pixels, self.width, depth, self.camera, self.pair,
            other_mask, positions, slopes,
        )  # fmt: skip
        return positions, slopes

    def reproject(self, positions: Tensor, found: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return noise and weights (m,), the noise's derivatives by the other view's depth (m,)
        and by the position (m, 2)."""
        count = len(self.pixels)
        noise, weights, by_found = found.new_empty((3, count), dtype=torch.float64).unbind()
        by_positions = found.new_empty((count, 2), dtype=torch.float64)
        self.kernels.launch_each(
            "return_points", count, self.pixels, self.width, positions, found, self.camera,
            self.pair, noise, weights, by_found, by_positions,
        )  # fmt: skip
        return noise, weights, by_found, by_positions

    def compare(
        self, noise: Tensor, images: tuple[Tensor, Tensor, Tensor], greys: tuple[Tensor, Tensor],
        masks: tuple[Tensor, Tensor], settings: MultiViewOptions,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        """Return states (m,), errors (m,), their derivatives by depth (m,) and normal (m, 3)."""
        count, height = len(self.pixels), images[0].shape[0]
        states = torch.empty(count, dtype=torch.uint8, device=noise.device)
        errors, by_depth = noise.new_empty((2, count)).unbind()
        by_normals = noise.new_empty((count, 3))
        self.kernels.launch(
            "compare_patches", -(-count // WARPS), count, self.pixels, noise, self.width, height,
            *images, self.camera, self.pair, *greys, *masks, int(settings.correlation == "squared"),
            settings.patch_sizes, ctypes.c_double(settings.max_rise),
            ctypes.c_double(SAMPLES * settings.min_contrast**2), states, errors, by_depth,
            by_normals,
        )  # fmt: skip
        return states, errors, by_depth, by_normals
