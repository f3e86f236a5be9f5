# SPDX-License-Identifier: GPL-3.0-or-later
"""The losses of training, as functions of a render that torch can differentiate (method.md 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..dataset.camera import Camera
from ..errors import UsageError
from ..evaluation.view_metrics import as_unit_floats, similarity
from ..parallel import default_threads, even_bounds, run_chunks
from .loss_kernels import agreement_rows, color_error_rows, gather_depth_rows, normal_rows

_NO_MASK = np.zeros((0, 0), np.bool_)


@dataclass
class ColorFigures:
    """What the colour loss measured on the way, over unmasked values."""

    l1: float
    mean_squared: float
    ssim: float


@dataclass
class NormalFigures:
    """What the normal losses measured on the way: means of ``1 - cos`` over all pixels."""

    depth_normal: float
    normal: float
    valid_share: float
    """Share of the pixels where the depth has a normal."""


class _WithGradients(torch.autograd.Function):
    """A scalar whose gradients were computed along with it."""

    @staticmethod
    def forward(ctx: Any, value: float, gradients: tuple[np.ndarray, ...], *inputs: Tensor) -> Any:
        ctx.save_for_backward(*(torch.from_numpy(g) for g in gradients))
        return inputs[0].new_tensor(value)

    @staticmethod
    def backward(ctx: Any, *outputs: Any) -> Any:
        factor = outputs[0]
        return (None, None, *(factor * g for g in ctx.saved_tensors))


def color_loss(
    image: Tensor,
    photo: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    lambda_dssim: float = 0.2,
    threads: int = 0,
) -> tuple[Tensor, ColorFigures]:
    """Return ``(1 - lambda) L1 + lambda (1 - SSIM)`` and what was measured (method.md 3.1).

    Parameters
    ----------
    image : (h, w, 3) float32 or float64
        The render.
    photo : (h, w, 3) uint8, or floats in [0, 1]
    mask : (h, w) bool, optional
        False pixels count in no term.
    lambda_dssim : float
        Share of the SSIM term. It is 0 where the image is smaller than the SSIM window.

    Returns
    -------
    loss : scalar tensor
        Differentiable once with respect to ``image``; 0 where the mask leaves no pixel.
    figures : ColorFigures

    Raises
    ------
    UsageError
        If the shapes differ.
    """
    threads = threads or default_threads()
    pixels = np.ascontiguousarray(image.detach().numpy())
    target = as_unit_floats(photo, pixels.dtype.type)
    height, width = pixels.shape[:2]
    similar = similarity(pixels, target, mask, gradient=True, threads=threads)
    if similar.values == 0:
        lambda_dssim = 0.0
    assert similar.gradient is not None
    gradient = similar.gradient
    gradient *= -lambda_dssim
    flat_mask = _NO_MASK if mask is None else np.ascontiguousarray(mask, np.bool_)
    values = 3 * (height * width if mask is None else int(flat_mask.sum()))
    factor = (1.0 - lambda_dssim) / max(1, values)
    absolute, squared = np.zeros(height), np.zeros(height)
    flat = (pixels.reshape(height, -1), target.reshape(height, -1), gradient.reshape(height, -1))

    def run(begin: int, end: int) -> None:
        color_error_rows(
            begin, end, flat[0], flat[1], flat_mask, factor, flat[2], absolute, squared
        )

    run_chunks(run, even_bounds(height, threads, 1), threads)
    l1 = float(absolute.sum()) / max(1, values)
    value = (1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - similar.mean)
    figures = ColorFigures(l1, float(squared.sum()) / max(1, values), similar.mean)
    return _WithGradients.apply(value, (gradient,), image), figures


def normals_from_depth(
    depth: np.ndarray, camera: Camera, *, max_jump: float = 0.0, threads: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals of a depth map, facing the camera (method.md 2.8).

    The cross product of central differences of the back-projected depth.

    Parameters
    ----------
    depth : (h, w)
        z-depth, scene units; <= 0 where there is none.
    camera : Camera
        Of the same size.
    max_jump : float
        No normal where opposite neighbours differ by more than this share of the depth; 0 = off.

    Returns
    -------
    normals : (h, w, 3)
        Scene frame, of the depth's float type; 0 where not valid.
    valid : (h, w) bool
        The pixel is not on the border and all five pixels of the cross have depth.
    """
    local, valid, _ = _camera_normals(depth, camera, max_jump, threads or default_threads())
    return local @ camera.rotation.astype(local.dtype), valid


def normal_losses(
    depth: Tensor,
    geometric_normal: Tensor,
    normal: Tensor,
    alpha: Tensor,
    camera: Camera,
    mask: np.ndarray | None = None,
    *,
    lambda_depth_normal: float = 0.05,
    lambda_normal: float = 0.03,
    max_jump: float = 0.0,
    threads: int = 0,
) -> tuple[Tensor, NormalFigures]:
    """Return ``lambda_DN L_DN + lambda_N L_N`` and both means (method.md 3.2 and 3.3).

    ``L_DN = mean(valid (1 - n_geo / alpha . n_depth))`` and ``L_N = mean(valid (1 - N . n_depth))``
    over all pixels of the image (of the mask), with the normals of
    :func:`normals_from_depth`. Nothing is detached.

    Parameters
    ----------
    depth, alpha : (h, w) tensors
        Of the render.
    geometric_normal, normal : (h, w, 3) tensors
        Blended normals of the render, scene frame.
    camera : Camera
        Of the same size, scene frame.
    mask : (h, w) bool, optional
        False pixels count in no term.

    Returns
    -------
    loss : scalar tensor
        Differentiable once with respect to all four images.
    figures : NormalFigures

    Raises
    ------
    UsageError
        If the camera's size is not the image's.
    """
    threads = threads or default_threads()
    inputs = (depth, geometric_normal, normal, alpha)
    z, geometric, learned, cover = (np.ascontiguousarray(t.detach().numpy()) for t in inputs)
    height, width = z.shape
    normals, valid, inverse_length = _camera_normals(z, camera, max_jump, threads)
    flat_mask = _NO_MASK if mask is None else np.ascontiguousarray(mask, np.bool_)
    pixels = max(1, height * width if mask is None else int(flat_mask.sum()))
    sums = np.zeros((height, 2))
    by_geometric, by_learned = np.empty_like(geometric), np.empty_like(learned)
    by_depth, by_alpha = np.empty_like(z), np.empty_like(cover)
    by_neighbour = np.empty((4, height, width), z.dtype)
    packed, rotation = _pack(camera), np.ascontiguousarray(camera.rotation)

    def run(begin: int, end: int) -> None:
        agreement_rows(
            begin, end, z, packed, rotation, flat_mask, geometric, learned, cover, normals, valid,
            inverse_length, lambda_depth_normal / pixels, lambda_normal / pixels, sums,
            by_geometric, by_learned, by_alpha, by_neighbour,
        )  # fmt: skip

    def gather(begin: int, end: int) -> None:
        gather_depth_rows(begin, end, by_neighbour, by_depth)

    bounds = even_bounds(height, threads, 2)
    run_chunks(run, bounds, threads)
    run_chunks(gather, bounds, threads)
    depth_normal, oriented = (sums.sum(0) / pixels).tolist()
    used = valid if mask is None else valid & flat_mask
    figures = NormalFigures(depth_normal, oriented, float(used.sum()) / pixels)
    value = lambda_depth_normal * depth_normal + lambda_normal * oriented
    gradients = (by_depth, by_geometric, by_learned, by_alpha)
    return _WithGradients.apply(value, gradients, *inputs), figures


def _camera_normals(
    depth: np.ndarray, camera: Camera, max_jump: float, threads: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    height, width = depth.shape
    if (height, width) != (camera.height, camera.width):
        raise UsageError(
            f"The depth map is {width} x {height} px, the camera {camera.width} x {camera.height}.",
            "Use the camera that rendered it.",
        )
    depth = np.ascontiguousarray(depth)
    normals = np.empty((height, width, 3), depth.dtype)
    valid = np.empty((height, width), np.bool_)
    inverse_length = np.zeros((height, width), depth.dtype)
    packed = _pack(camera)

    def run(begin: int, end: int) -> None:
        normal_rows(begin, end, depth, packed, max_jump, normals, valid, inverse_length)

    run_chunks(run, even_bounds(height, threads, 2), threads)
    return normals, valid, inverse_length


def _pack(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
