# SPDX-License-Identifier: GPL-3.0-or-later
"""The fast renderer on a GPU: the same images, depth, gradients and statistics as on the CPU.

No per-Gaussian or per-pixel data is copied to the host, except requested statistics.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ... import tolerances
from ...dataset.camera import Camera
from ...errors import ResourceError, UsageError
from ...gaussians.model import OrientedGaussians
from ..types.images import Render, RenderStatistics
from ..types.options import RenderOptions
from .kernels import Kernels, device_kernels
from .tile_lists import (
    ROW_VALUES,
    WARPS,
    Band,
    DeviceScreen,
    RawTensors,
    bin_bands,
    project,
)

_TRAINED = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
_BUDGET_SHARE = 0.5
"""Share of the free GPU memory used for tile intersections."""


def render_cuda(
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions | None = None,
    *,
    budget_bytes: int = 0,
) -> Render:
    """Render on the GPU that holds the Gaussians; see :func:`~.render.render`.

    Bitwise reproducible on the same GPU.

    Parameters
    ----------
    gaussians : OrientedGaussians
        CUDA tensors, float32, scene frame.
    camera : Camera
        In the scene frame.
    options : RenderOptions, optional
        ``threads`` and ``budget_bytes``, which is for the CPU's lists, are not used.
    budget_bytes : int
        GPU memory for tile intersections; 0 uses half of what is free.

    Raises
    ------
    UsageError
        If the tensors are not float32 or not on one GPU.
    DeviceError
        If the compiler or the driver is missing or fails.
    ResourceError
        If the GPU memory does not suffice.
    """
    device = gaussians.means.device
    if device.type != "cuda":
        raise UsageError("The Gaussians are not on a GPU.", "Use render() for CPU tensors.")
    index = device.index if device.index is not None else torch.cuda.current_device()
    budget = budget_bytes or _free_bytes(device)
    return render_with(device_kernels(index), gaussians, camera, options, budget)


def render_with(
    kernels: Kernels,
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions | None,
    budget_bytes: int,
) -> Render:
    """Render with the given kernels on the tensors' device; see :func:`render_cuda`."""
    options = options or RenderOptions()
    device = gaussians.means.device
    for name, tensor in gaussians.tensors():
        if tensor.dtype != torch.float32 or tensor.device != device:
            raise UsageError(
                f"{name} of the Gaussians is {tensor.dtype} on {tensor.device}.",
                f"Give float32 on {device}.",
            )
    count = len(gaussians)
    statistics = _empty_statistics(count, options) if options.gathers_statistics else None
    tensors = [getattr(gaussians, name) for name in _TRAINED]
    with _translate_out_of_memory(camera):
        images = _Rasterize.apply(
            *tensors, kernels, gaussians, camera, options, statistics, budget_bytes
        )
    color, normal, geometric, alpha, depth = images
    return Render(color, normal, geometric, alpha, depth, statistics)


@contextlib.contextmanager
def _translate_out_of_memory(camera: Camera) -> Iterator[None]:
    """Translate torch's out-of-memory error into a ``ResourceError``."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise ResourceError(
            f"GPU memory does not suffice for view {camera.name!r}: {error}.",
            "Use smaller images or fewer Gaussians, or render on the CPU.",
        ) from None


@dataclass(frozen=True)
class _Images:
    """Images that the kernels write, float32."""

    color: Tensor  # (h, w, 3)
    normal: Tensor  # (h, w, 3)
    geometric: Tensor  # (h, w, 3)
    alpha: Tensor  # (h, w)
    depth: Tensor  # (h, w)
    slope: Tensor  # (h, w); (0,) without depth
    strongest: Tensor  # (h, w) int32; (0,) without statistics


class _Rasterize(torch.autograd.Function):
    """Projection, binning and blending as one differentiable step."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        opacity_logits: Tensor,
        sh: Tensor,
        orientation: Tensor,
        kernels: Kernels,
        gaussians: OrientedGaussians,
        camera: Camera,
        options: RenderOptions,
        statistics: RenderStatistics | None,
        budget_bytes: int,
    ) -> tuple[Tensor, ...]:
        raw = RawTensors.of(gaussians, camera, options)
        screen = project(kernels, raw)
        images = _allocate(camera, options, means.device)
        bands = []
        sums = _BandSums.zeros(len(means), options, means.device)
        for band in bin_bands(kernels, screen, camera, budget_bytes):
            _blend(kernels, screen, band, camera, options, images, sums)
            bands.append(band)
        if statistics is not None:
            _fill_statistics(statistics, screen, images, sums)
        ctx.set_materialize_grads(False)
        ctx.kernels, ctx.raw, ctx.screen, ctx.bands = kernels, raw, screen, bands
        ctx.camera, ctx.options, ctx.statistics = camera, options, statistics
        ctx.slope = images.slope
        outputs = (images.color, images.normal, images.geometric, images.alpha, images.depth)
        # Saved so that autograd refuses to run backward after one was modified in place.
        ctx.save_for_backward(means, log_scales, quats, opacity_logits, sh, orientation, *outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        with _translate_out_of_memory(ctx.camera):
            return (*_backward(ctx, grads), *[None] * 6)


def _backward(ctx: Any, grads: tuple[Tensor | None, ...]) -> list[Tensor]:
    """Return the gradients of the trained tensors."""
    kernels, statistics = ctx.kernels, ctx.statistics
    outputs = ctx.saved_tensors[len(_TRAINED) :]
    incoming = [
        torch.zeros_like(output) if grad is None else grad.detach().contiguous()
        for output, grad in zip(outputs, grads, strict=True)
    ]
    with_depth = ctx.options.depth and grads[4] is not None
    name = "backward_tiles" + ("_depth" if with_depth else "")
    name += "_absolute" if statistics is not None else ""
    params = ctx.screen.params
    grad_params = torch.zeros_like(params)  # (n, 24)
    for band in ctx.bands:
        intersections = params.new_empty((len(band.gaussian_ids), ROW_VALUES))
        kernels.launch(
            name,
            band.tiles,
            params,
            band.start,
            band.gaussian_ids,
            band.intersection_slots,
            band.masks,
            *_band_geometry(ctx.camera, band),
            *outputs,
            ctx.slope,
            *incoming,
            intersections,
        )
        blocks = -(-len(params) // WARPS)
        kernels.launch(
            "sum_pairs", blocks, len(params), intersections, band.intersection_offsets, grad_params
        )
    gathers = statistics is not None
    norms = params.new_empty((2, len(params) if gathers else 0))
    kernels.launch_each("finish_params", len(params), int(gathers), grad_params, norms[0], norms[1])
    if gathers:
        statistics.grad_px[:], statistics.grad_abs_px[:] = norms.cpu().numpy()
    raw = ctx.raw
    found = [torch.zeros_like(getattr(raw.gaussians, trained)) for trained in _TRAINED]
    kernels.launch_each(
        "project_backward",
        len(params),
        *raw.arguments(),
        ctx.screen.visible,
        grad_params,
        *found,
    )
    return found


def _blend(
    kernels: Kernels,
    screen: DeviceScreen,
    band: Band,
    camera: Camera,
    options: RenderOptions,
    images: _Images,
    sums: _BandSums,
) -> None:
    weighed = options.statistics
    intersection_weights = screen.params.new_zeros((len(band.gaussian_ids) if weighed else 0, 2))
    kernels.launch(
        "forward_tiles_weights" if weighed else "forward_tiles",
        band.tiles,
        screen.params,
        screen.boxes,
        screen.skews,
        band.start,
        band.gaussian_ids,
        band.intersection_slots,
        *_band_geometry(camera, band),
        *(float(value) for value in options.background),
        images.color,
        images.normal,
        images.geometric,
        images.alpha,
        band.masks,
        intersection_weights,
        images.strongest,
    )
    if options.gathers_statistics:
        sums.reached.logical_or_(band.intersection_offsets.diff() > 0)
    if weighed:
        kernels.launch_each(
            "sum_weights",
            len(screen.params),
            intersection_weights,
            band.intersection_offsets,
            sums.weight_sum,
            sums.weight_max,
        )
    if options.depth:
        kernels.launch(
            "isosurface_tiles",
            band.tiles,
            screen.params,
            band.start,
            band.gaussian_ids,
            band.masks,
            *_band_geometry(camera, band),
            float(options.depth_valid_transmittance),
            images.alpha,
            images.depth,
            images.slope,
        )


@dataclass(frozen=True)
class _BandSums:
    """What the bands of an image say of each Gaussian; (n,), or (0,) where nobody asked."""

    reached: Tensor  # bool: has a tile in the image
    weight_sum: Tensor
    weight_max: Tensor

    @classmethod
    def zeros(cls, count: int, options: RenderOptions, device: torch.device) -> _BandSums:
        reached = count if options.gathers_statistics else 0
        weighed = count if options.statistics else 0
        return cls(
            torch.zeros(reached, dtype=torch.bool, device=device),
            torch.zeros(weighed, device=device),
            torch.zeros(weighed, device=device),
        )


def _band_geometry(camera: Camera, band: Band) -> tuple[int, int, int, int]:
    """Return tiles per row, the band's first tile row, and the image size in pixels."""
    tiles_x = -(-camera.width // tolerances.TILE_PX)
    return tiles_x, band.first_row, camera.width, camera.height


def _allocate(camera: Camera, options: RenderOptions, device: torch.device) -> _Images:
    """Return images for the kernels to fill; depth is 0 unless it is solved."""
    shape = (camera.height, camera.width)
    return _Images(
        torch.empty((*shape, 3), device=device),
        torch.empty((*shape, 3), device=device),
        torch.empty((*shape, 3), device=device),
        torch.empty(shape, device=device),
        torch.zeros(shape, device=device),
        torch.empty(shape if options.depth else (0,), device=device),
        torch.empty(shape if options.statistics else (0,), dtype=torch.int32, device=device),
    )


def _free_bytes(device: torch.device) -> int:
    free, _ = torch.cuda.mem_get_info(device)
    # torch caches freed memory.
    kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return int(_BUDGET_SHARE * (free + kept))


def _empty_statistics(count: int, options: RenderOptions) -> RenderStatistics:
    weighed = count if options.statistics else 0
    return RenderStatistics(
        visible=np.zeros(count, np.bool_),
        radii_px=np.zeros(count, np.float32),
        weight_sum=np.zeros(weighed, np.float32),
        weight_max=np.zeros(weighed, np.float32),
        grad_px=np.zeros(count, np.float32),
        grad_abs_px=np.zeros(count, np.float32),
    )


def _fill_statistics(
    statistics: RenderStatistics, screen: DeviceScreen, images: _Images, sums: _BandSums
) -> None:
    sides = (screen.boxes[:, 2:] - screen.boxes[:, :2]).amax(1)  # (n,)
    statistics.visible = sums.reached.cpu().numpy()
    statistics.radii_px = torch.where(sums.reached, 0.5 * sides, 0.0).cpu().numpy()
    statistics.weight_sum = sums.weight_sum.cpu().numpy()
    statistics.weight_max = sums.weight_max.cpu().numpy()
    if images.strongest.numel():
        statistics.strongest = images.strongest.cpu().numpy()
