# SPDX-License-Identifier: GPL-3.0-or-later
"""Density statistics whose running sums lie on a device."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...render.cuda.device_view import DeviceView
from .density_control import DensityStatistics


class DeviceDensityStatistics(DensityStatistics):
    """Running sums on a device; what density control and checkpoints read is copied to the host.

    Parameters
    ----------
    statistics : DensityStatistics
        Sums so far.
    device : torch.device
    """

    def __init__(self, statistics: DensityStatistics, device: torch.device) -> None:
        self.device = device
        self._gradient, self._gradient_abs, self._views = (
            torch.from_numpy(np.array(array)).to(device)
            for array in (statistics.gradient, statistics.gradient_abs, statistics.views)
        )

    gradient = property(lambda self: _read(self._gradient))
    gradient_abs = property(lambda self: _read(self._gradient_abs))
    views = property(lambda self: _read(self._views))

    def cleared(self, count: int) -> DeviceDensityStatistics:
        """Return empty statistics of ``count`` Gaussians on the same device."""
        return DeviceDensityStatistics(DensityStatistics.zeros(count), self.device)

    def on_host(self) -> DensityStatistics:
        """Return a copy that lies on the host."""
        return DensityStatistics(self.gradient, self.gradient_abs, self.views)

    def add_view(self, view: DeviceView, width: int, height: int, part: float = 1.0) -> None:
        """Accumulate one view after its backward pass; see :meth:`.DensityStatistics.add`."""
        measured = view.statistics
        half_image = 0.5 * max(width, height) * part
        weight = measured.reached.to(torch.float32).mul_(half_image)
        self._gradient.addcmul_(weight, measured.grad_px)
        self._gradient_abs.addcmul_(weight, measured.grad_abs_px)
        self._views += measured.reached


def _read(tensor: Tensor) -> np.ndarray:
    return tensor.to("cpu", copy=True).numpy()
