# SPDX-License-Identifier: GPL-3.0-or-later
"""Colour and normal losses with their gradients on the rendered images.

See docs/method.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...dataset.camera import Camera
from ...errors import UsageError
from ...imaging.view_metrics import compare, has_windows
from ...kernels.array_store import ArrayStore
from ...kernels.parallel import default_threads, even_bounds, run_chunks
from ...render.types.gradients import ImageGradients
from .loss_kernels import agreement_rows, normal_rows

_NO_MASK = np.zeros((0, 0), np.bool_)


@dataclass
class ColorMetrics:
    """Image metrics from the colour loss, over unmasked values."""

    l1: float
    mean_squared: float
    ssim: float


@dataclass
class NormalMetrics:
    """Terms of the normal losses: means of ``1 - cos`` over all pixels."""

    depth_normal: float
    normal: float
    valid_share: float
    """Share of the pixels where the depth has a normal."""


def color_loss(
    image: np.ndarray,
    photo: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    lambda_dssim: float = 0.2,
    threads: int = 0,
    store: ArrayStore | None = None,
) -> tuple[float, np.ndarray, ColorMetrics]:
    """Return ``(1 - lambda) L1 + lambda (1 - SSIM)``, its gradient and metrics.

    See docs/method.md, section 3.1.

    Parameters
    ----------
    image : (h, w, 3) float32 or float64
        The render.
    photo : (h, w, 3) uint8, or floats in [0, 1]
    mask : (h, w) bool, optional
        False pixels count in no term.
    lambda_dssim : float
        Weight of the SSIM term; 0 is used if no window of SSIM fits or is unmasked.
    store : ArrayStore, optional
        Memory for the gradient, which is then valid until the next call.

    Returns
    -------
    loss : float
        0 if the mask leaves no pixel.
    gradient : (h, w, 3), of the image's type
    figures : ColorMetrics

    Raises
    ------
    UsageError
        If the shapes differ.
    """
    threads = threads or default_threads()
    if not has_windows(image.shape, mask):
        lambda_dssim = 0.0
    weights = (1.0 - lambda_dssim, -lambda_dssim)
    out = _take(store, "by color", image)
    found = compare(image, photo, mask, weights=weights, threads=threads, out=out)
    assert found.gradient is not None
    value = (1.0 - lambda_dssim) * found.absolute + lambda_dssim * (1.0 - found.similarity)
    return value, found.gradient, ColorMetrics(found.absolute, found.squared, found.similarity)


def normals_from_depth(
    depth: np.ndarray, camera: Camera, *, max_jump: float = 0.0, threads: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals of a depth map, facing the camera (docs/method.md, section 2.8).

    Cross products of central differences of the back-projected depth.

    Parameters
    ----------
    depth : (h, w)
        z-depth, scene units; <= 0 where there is none.
    camera : Camera
        Camera of the same size.
    max_jump : float
        No normal where opposite neighbours differ by more than this share of the depth; 0 = off.

    Returns
    -------
    normals : (h, w, 3)
        Scene frame, of the depth's float type; 0 where not valid.
    valid : (h, w) bool
        The pixel is not on the border and all five pixels of the cross have depth.
    """
    threads = threads or default_threads()
    _check_size(depth, camera)
    depth = np.ascontiguousarray(depth)
    local = np.empty((*depth.shape, 3), depth.dtype)  # camera frame
    valid = np.empty(depth.shape, np.bool_)
    packed = _pack(camera)

    def run(begin: int, end: int) -> None:
        normal_rows(begin, end, depth, packed, max_jump, local, valid)

    run_chunks(run, even_bounds(len(depth), threads, 2), threads)
    return local @ camera.rotation.astype(local.dtype), valid


def normal_losses(
    depth: np.ndarray,
    geometric_normal: np.ndarray,
    normal: np.ndarray,
    alpha: np.ndarray,
    camera: Camera,
    mask: np.ndarray | None = None,
    *,
    lambda_depth_normal: float = 0.05,
    lambda_normal: float = 0.03,
    max_jump: float = 0.0,
    threads: int = 0,
    store: ArrayStore | None = None,
) -> tuple[float, ImageGradients, NormalMetrics]:
    """Return ``lambda_DN L_DN + lambda_N L_N``, its gradients and both means.

    See docs/method.md, sections 3.2 and 3.3.

    ``L_DN = mean(valid (1 - n_geo / alpha . n_depth))`` and ``L_N = mean(valid (1 - N . n_depth))``
    over all pixels of the image (of the mask), with the normals of :func:`normals_from_depth`.
    Gradients flow through all terms.

    Parameters
    ----------
    depth, alpha : (h, w) float32 or float64
        Rendered images.
    geometric_normal, normal : (h, w, 3), the same type
        Blended normals of the render, scene frame.
    camera : Camera
        Of the same size, scene frame.
    mask : (h, w) bool, optional
        False pixels count in no term.
    store : ArrayStore, optional
        Memory for the gradients, which are then valid until the next call.

    Returns
    -------
    loss : float
    gradients : ImageGradients
        On all four images; none on the colour.
    figures : NormalMetrics

    Raises
    ------
    UsageError
        If the camera's size is not the image's.
    """
    threads = threads or default_threads()
    _check_size(depth, camera)
    height, width = depth.shape
    z, cover = np.ascontiguousarray(depth), np.ascontiguousarray(alpha)
    geometric = np.ascontiguousarray(geometric_normal).reshape(height, -1)  # (h, 3 w)
    learned = np.ascontiguousarray(normal).reshape(height, -1)
    flat_mask = _NO_MASK if mask is None else np.ascontiguousarray(mask, np.bool_)
    pixels = max(1, height * width if mask is None else int(np.count_nonzero(flat_mask)))
    sums = np.empty((height, 3))
    by_geometric, by_learned = (
        _take(store, name, geometric) for name in ("by geometric normal", "by normal")
    )
    by_depth, by_alpha = (_take(store, name, z) for name in ("by depth", "by alpha"))
    packed, rotation = _pack(camera), np.ascontiguousarray(camera.rotation)

    def run(begin: int, end: int) -> None:
        agreement_rows(
            begin, end, z, packed, rotation, flat_mask, geometric, learned, cover, max_jump,
            lambda_depth_normal / pixels, lambda_normal / pixels, sums,
            by_depth, by_geometric, by_learned, by_alpha,
        )  # fmt: skip

    run_chunks(run, even_bounds(height, threads, 1), threads)
    depth_normal, oriented, share = (sums.sum(0) / pixels).tolist()
    value = lambda_depth_normal * depth_normal + lambda_normal * oriented
    gradients = ImageGradients(
        normal=by_learned.reshape(height, width, 3),
        geometric_normal=by_geometric.reshape(height, width, 3),
        alpha=by_alpha,
        depth=by_depth,
    )
    return value, gradients, NormalMetrics(depth_normal, oriented, share)


def _take(store: ArrayStore | None, name: str, like: np.ndarray) -> np.ndarray:
    if store is None:
        return np.empty(like.shape, like.dtype)
    return store.take(name, like.shape, like.dtype)


def _check_size(depth: np.ndarray, camera: Camera) -> None:
    height, width = depth.shape
    if (height, width) != (camera.height, camera.width):
        raise UsageError(
            f"The depth map is {width} x {height} px, the camera {camera.width} x {camera.height}.",
            "Use the camera that rendered it.",
        )


def _pack(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
