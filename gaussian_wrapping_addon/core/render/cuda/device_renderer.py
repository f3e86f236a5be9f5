# SPDX-License-Identifier: GPL-3.0-or-later
"""``ViewRenderer`` on a device: the same interface of numpy arrays, rendered by CUDA kernels.

For what looks at whole views between the iterations of a training: contributions, votes, trials,
pictures. Images are copied to the host only where they are read.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...dataset.camera import Camera
from ...gaussians.model import TRAINED, OrientedGaussians
from ..projection.projection import RawArrays
from ..types.gradients import ImageGradients, VisibleGradients
from ..types.images import RenderStatistics
from ..types.options import RenderOptions
from .cuda_render import empty_statistics, fill_statistics, free_budget_bytes
from .device_view import IMAGES, DeviceView
from .kernels import Kernels, device_kernels


class DeviceViewPass:
    """One rendered view as numpy arrays; see :class:`~..view_renderer.ViewPass`."""

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

    The Gaussians of the last call stay on the device and are not sent again.

    Parameters
    ----------
    kernels : Kernels
    device : torch.device
    budget_bytes : callable
        Device memory that tile intersections may take now.
    """

    def __init__(
        self, kernels: Kernels, device: torch.device, budget_bytes: Callable[[], int]
    ) -> None:
        self.kernels, self.device, self.budget_bytes = kernels, device, budget_bytes
        self._sent: tuple[RawArrays, OrientedGaussians] | None = None

    def render(
        self, gaussians: RawArrays, camera: Camera, options: RenderOptions | None = None
    ) -> DeviceViewPass:
        """Render like :meth:`~..view_renderer.ViewRenderer.render`.

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

    Raises
    ------
    DeviceError
        If the compiler or the driver is missing or fails.
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
