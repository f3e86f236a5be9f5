# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole images on the device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import UsageError
from ...gaussians.model import TRAINED, OrientedGaussians
from ...scene.camera import Camera
from ..projection import RawArrays
from ..types import ImageGradients, Render, RenderOptions, RenderStatistics, VisibleGradients
from .device_view import IMAGES, DeviceView
from .kernels import Kernels, device_kernels

# -- The fast renderer on a GPU: the same images, depth, gradients and statistics as on the CPU
#
# No per-Gaussian or per-pixel data is copied to the host, except requested statistics.


_BUDGET_SHARE = 0.5
"""Share of the free GPU memory used for tile intersections."""


def render_cuda(
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions | None = None,
    *,
    budget_bytes: int = 0,
) -> Render:
    """Render on the GPU that holds the float32 Gaussians; see :func:`~.render`.

    Bitwise reproducible on the same GPU. ``budget_bytes`` is GPU memory for tile intersections, 0
    for half of what is free; the options' own, and ``threads``, are for the CPU.

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
    budget = budget_bytes or free_budget_bytes(device)
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
    statistics = empty_statistics(len(gaussians), options) if options.gathers_statistics else None
    tensors = [getattr(gaussians, name) for name in TRAINED]
    images = _Rasterize.apply(
        *tensors, kernels, gaussians, camera, options, statistics, budget_bytes
    )
    color, normal, geometric, alpha, depth = images
    return Render(color, normal, geometric, alpha, depth, statistics)


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
        view = DeviceView(kernels, gaussians.detached(), camera, options, budget_bytes)
        if statistics is not None:
            fill_statistics(statistics, view)
        ctx.set_materialize_grads(False)
        ctx.view, ctx.statistics = view, statistics
        outputs = tuple(getattr(view, name) for name in IMAGES)
        # Saved so that autograd refuses to run backward after one was modified in place.
        ctx.save_for_backward(means, log_scales, quats, opacity_logits, sh, orientation, *outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        ctx.saved_tensors  # noqa: B018 - raises where one was modified in place
        incoming = [None if grad is None else grad.detach().contiguous() for grad in grads]
        found = ctx.view.backward(incoming)
        if ctx.statistics is not None:
            measured = ctx.view.statistics
            ctx.statistics.grad_px[:] = measured.grad_px.cpu().numpy()
            ctx.statistics.grad_abs_px[:] = measured.grad_abs_px.cpu().numpy()
        return (*(found[name] for name in TRAINED), *[None] * 6)


def free_budget_bytes(device: torch.device) -> int:
    """Return the GPU memory that tile intersections may take now."""
    free, _ = torch.cuda.mem_get_info(device)
    # torch caches freed memory.
    kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return int(_BUDGET_SHARE * (free + kept))


def empty_statistics(count: int, options: RenderOptions) -> RenderStatistics:
    """Return statistics of zeros for ``count`` Gaussians."""
    weighed = count if options.statistics else 0
    return RenderStatistics(
        visible=np.zeros(count, np.bool_), radii_px=np.zeros(count, np.float32),
        weight_sum=np.zeros(weighed, np.float32), weight_max=np.zeros(weighed, np.float32),
        grad_px=np.zeros(count, np.float32), grad_abs_px=np.zeros(count, np.float32),
    )  # fmt: skip


def fill_statistics(statistics: RenderStatistics, view: DeviceView) -> None:
    """Copy to the host what the forward pass knows of each Gaussian."""
    measured = view.statistics
    statistics.visible = measured.reached.cpu().numpy()
    statistics.radii_px = view.radii_px().cpu().numpy()
    statistics.weight_sum = measured.weight_sum.cpu().numpy()
    statistics.weight_max = measured.weight_max.cpu().numpy()
    if view.images.strongest.numel():
        statistics.strongest = view.images.strongest.cpu().numpy()


# -- ``ViewRenderer`` on a device: the same interface of numpy arrays, rendered by CUDA kernels
#
# For what looks at whole views between the iterations of a training: contributions, votes,
# trials, pictures. Images are copied to the host only where they are read.


class DeviceViewPass:
    """One rendered view as numpy arrays; see :class:`~.view_renderer.ViewPass`."""

    def __init__(self, view: DeviceView, options: RenderOptions) -> None:
        self.view = view
        self._copies: dict[str, np.ndarray] = {}
        self.statistics: RenderStatistics | None = None
        if options.gathers_statistics:
            self.statistics = empty_statistics(len(view), options)
            fill_statistics(self.statistics, view)

    def _image(self, name: str) -> np.ndarray:
        if name not in self._copies:
            self._copies[name] = getattr(self.view, name).cpu().numpy()
        return self._copies[name]

    color = property(lambda self: self._image("color"))
    normal = property(lambda self: self._image("normal"))
    geometric_normal = property(lambda self: self._image("geometric_normal"))
    alpha = property(lambda self: self._image("alpha"))
    depth = property(lambda self: self._image("depth"))

    @property
    def ids(self) -> np.ndarray:
        """(v,) int32: the Gaussians that reach a tile of the image, increasing."""
        reached = self.view.statistics.reached.cpu().numpy()
        return np.flatnonzero(reached).astype(np.int32)

    def backward(self, grads: ImageGradients) -> VisibleGradients:
        """Return the gradients on the Gaussians that reach a tile of the image."""
        device = self.view.color.device
        incoming = [
            None if (grad := getattr(grads, name)) is None else _sent(grad, device)
            for name in IMAGES
        ]
        found = self.view.backward(incoming)
        if self.statistics is not None:
            measured = self.view.statistics
            self.statistics.grad_px[:] = measured.grad_px.cpu().numpy()
            self.statistics.grad_abs_px[:] = measured.grad_abs_px.cpu().numpy()
        ids = self.ids
        rows = torch.from_numpy(ids.astype(np.int64)).to(device)
        return VisibleGradients(ids, **{name: found[name][rows].cpu().numpy() for name in TRAINED})


class DeviceRenderer:
    """Renders views of Gaussians on the host by the kernels of a device.

    The Gaussians of the last call stay on the device and are not sent again. ``budget_bytes()`` is
    the device memory that tile intersections may take now.
    """

    def __init__(
        self, kernels: Kernels, device: torch.device, budget_bytes: Callable[[], int]
    ) -> None:
        self.kernels, self.device, self.budget_bytes = kernels, device, budget_bytes
        self._sent: tuple[RawArrays, OrientedGaussians] | None = None

    def render(
        self, gaussians: RawArrays, camera: Camera, options: RenderOptions | None = None
    ) -> DeviceViewPass:
        """Render like :meth:`~.view_renderer.ViewRenderer.render`.

        The arrays must not change between two calls with the same object.
        """
        options = options or RenderOptions()
        if self._sent is None or self._sent[0] is not gaussians:
            self._sent = None  # before the next ones are sent
            self._sent = gaussians, _gaussians_on(gaussians, self.device)
        view = DeviceView(self.kernels, self._sent[1], camera, options, self.budget_bytes())
        return DeviceViewPass(view, options)

    def release(self) -> None:
        """Free the device memory of the Gaussians rendered last."""
        self._sent = None


def device_renderer(device: str) -> DeviceRenderer:
    """Return the renderer of a GPU such as ``"cuda:0"``.

    Raises DeviceError if the compiler or the driver is missing or fails.
    """
    gpu = torch.device(device)
    index = torch.cuda.current_device() if gpu.index is None else gpu.index
    return DeviceRenderer(device_kernels(index), gpu, lambda: free_budget_bytes(gpu))


def _gaussians_on(raw: RawArrays, device: torch.device) -> OrientedGaussians:
    names = (*TRAINED, "filter_3d")
    tensors: dict[str, Any] = {name: _sent(getattr(raw, name), device) for name in names}
    return OrientedGaussians(**tensors)


def _sent(array: np.ndarray, device: torch.device) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(device)
