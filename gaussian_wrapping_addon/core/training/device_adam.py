# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam whose values and moments lie on a device, with the interface of the CPU's."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ..gaussians.model import OrientedGaussians
from ..render.cuda.kernels import THREADS_PER_BLOCK, Kernels
from .adam import SH_COLUMN, Adam, corrections, packed_rates

_WARPS = THREADS_PER_BLOCK // 32


class DeviceAdam(Adam):
    """Adam on the tensors of a device, to which those of another are copied.

    What rounds between iterations read and write is copied: :meth:`array` and ``moments`` give
    copies on the host, which go back to the device before anything else uses it. Write to them at
    once, and fetch them anew after a step.
    """

    def __init__(self, adam: Adam, kernels: Kernels, device: torch.device) -> None:
        self.kernels, self.device = kernels, device
        on_host = adam.on_host()
        # Copies also where the device is the host's memory.
        self.tensors = {name: t.to(device, copy=True) for name, t in on_host.values.items()}
        self.device_moments = torch.from_numpy(on_host.all_moments.copy()).to(device)
        self.device_steps = torch.from_numpy(on_host.steps.copy()).to(device)
        self._corrections = torch.from_numpy(corrections().copy()).to(device)
        self._held: dict[str, Tensor] = {}
        self._held_moments: np.ndarray | None = None
        self._held_steps: np.ndarray | None = None
        self.frozen = adam.frozen

    def __len__(self) -> int:
        return len(self.device_steps)

    # -- the host's side --------------------------------------------------------------------------

    @property
    def values(self) -> dict[str, Tensor]:  # type: ignore[override]
        """Copies on the host; writing to them changes the Gaussians."""
        for name in self.tensors:
            self.array(name)
        return dict(self._held)

    @property
    def steps(self) -> np.ndarray:
        """Copy on the host; writing to it changes the steps."""
        if self._held_steps is None:
            self._held_steps = _copied(self.device_steps).numpy()
        return self._held_steps

    @steps.setter
    def steps(self, steps: np.ndarray) -> None:
        self._held_steps = np.array(steps, np.int32)

    @property
    def all_moments(self) -> np.ndarray:  # type: ignore[override]
        """Copy on the host; writing to it changes the moments."""
        if self._held_moments is None:
            self._held_moments = _copied(self.device_moments).numpy()
        return self._held_moments

    def gaussians(self) -> OrientedGaussians:
        """Return the current Gaussians on the host; not to be written to."""
        return OrientedGaussians(
            **{
                name: self._held[name] if name in self._held else _copied(tensor)
                for name, tensor in self.tensors.items()
            }
        )

    def array(self, name: str) -> np.ndarray:
        """Return a copy of one tensor on the host; writing to it changes the Gaussians."""
        if name not in self._held:
            self._held[name] = _copied(self.tensors[name])
        return self._held[name].numpy()

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of one tensor."""
        return tuple(self.tensors[name].shape)

    def on_host(self) -> Adam:
        """Return a copy that lies on the host."""
        self.send()
        copy = Adam(OrientedGaussians(**{n: _copied(t) for n, t in self.tensors.items()}))
        copy.all_moments[...] = _copied(self.device_moments).numpy()
        copy.steps = _copied(self.device_steps).numpy()
        copy.frozen = self.frozen
        return copy

    def copy(self) -> DeviceAdam:
        """Return a copy on the same device."""
        self.send()
        twin = object.__new__(DeviceAdam)
        twin.__dict__.update(self.__dict__)
        twin.tensors = {name: tensor.clone() for name, tensor in self.tensors.items()}
        twin.device_moments = self.device_moments.clone()
        twin.device_steps = self.device_steps.clone()
        twin._held = {}
        return twin

    # -- the device's side ------------------------------------------------------------------------

    def send(self) -> None:
        """Send what the host may have written to the device, and drop the host's copies."""
        for name, tensor in self._held.items():
            self.tensors[name].copy_(tensor)
        if self._held_moments is not None:
            self.device_moments.copy_(torch.from_numpy(self._held_moments))
        if self._held_steps is not None:
            self.device_steps.copy_(torch.from_numpy(self._held_steps))
        self._held, self._held_moments, self._held_steps = {}, None, None

    def on_device(self) -> OrientedGaussians:
        """Return the current Gaussians; the tensors are the trained ones."""
        self.send()
        return OrientedGaussians(**self.tensors)

    def step_all(
        self,
        gradients: Mapping[str, Tensor],
        rates: Mapping[str, np.ndarray],
        *,
        sh_degree: int | None = None,
    ) -> None:
        """Step the Gaussians of which any gradient is not 0, in place; see :meth:`.Adam.step_rows`.

        Parameters
        ----------
        gradients : mapping of name to tensor
            Of the shapes of the trained tensors, contiguous float32.
        """
        self.send()
        coefficients = self.tensors["sh"].shape[1]
        used = coefficients if sh_degree is None else min(coefficients, (sh_degree + 1) ** 2)
        columns = self.device_moments.shape[2]
        packed = torch.from_numpy(packed_rates(columns, rates)).to(self.device, non_blocking=True)
        names = ("quats", "orientation", "means", "opacity_logits", "log_scales", "sh")
        first = self.frozen
        self.kernels.launch(
            "adam_rows", -(-(len(self) - first) // _WARPS), len(self) - first, columns,
            SH_COLUMN + 3 * used, 3 * coefficients, *(self.tensors[name][first:] for name in names),
            *(gradients[name][first:] for name in names), self.device_moments[first:],
            self.device_steps[first:], self._corrections, len(self._corrections) - 1, packed,
        )  # fmt: skip

    def rebuild(
        self, parents: np.ndarray, fresh: np.ndarray, changes: Mapping[str, np.ndarray]
    ) -> None:
        """Replace all Gaussians by rows selected from the current ones; see :meth:`.Adam.rebuild`.

        The selection runs on the device; only the changes are sent.
        """
        self.send()
        rows = torch.from_numpy(np.ascontiguousarray(parents, np.int64)).to(self.device)
        new = torch.from_numpy(np.ascontiguousarray(fresh, np.bool_)).to(self.device)
        for name, tensor in self.tensors.items():
            if name in changes:
                array = np.ascontiguousarray(changes[name], np.float32)
                self.tensors[name] = torch.from_numpy(array).to(self.device, copy=True)
            else:
                self.tensors[name] = tensor[rows].contiguous()
        self.device_moments = self.device_moments[rows].masked_fill_(new[:, None, None], 0.0)
        self.device_steps = self.device_steps[rows].masked_fill_(new, 0)

    def is_finite(self) -> bool:
        """Tell whether every parameter is finite."""
        self.send()
        sums = torch.stack([tensor.sum() for tensor in self.tensors.values()])
        return bool(torch.isfinite(sums).all())


def _copied(tensor: Tensor) -> Tensor:
    """Return a contiguous copy on the host, also of a tensor that lies there."""
    return tensor.detach().to("cpu", copy=True).contiguous()
