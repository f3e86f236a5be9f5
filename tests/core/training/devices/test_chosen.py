# SPDX-License-Identifier: GPL-3.0-or-later
"""The backend of a chosen device."""

from __future__ import annotations

import sys

import pytest

from gaussian_wrapping_addon.core.errors import DeviceError
from gaussian_wrapping_addon.core.training import device_backend
from gaussian_wrapping_addon.core.training.cpu_backend import CpuBackend
from gaussian_wrapping_addon.core.training.device_backend import DeviceBackend, chosen_backend


def test_the_processor_needs_no_kernels_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    name = device_backend.__name__
    monkeypatch.setitem(sys.modules, name, None)  # importing it raises
    found = chosen_backend("cpu", 3)
    assert isinstance(found, CpuBackend)
    assert (found.name, found.threads) == ("cpu", 3)


@pytest.mark.parametrize(("device", "index"), [("cuda", 0), ("cuda:0", 0), ("cuda:2", 2)])
def test_a_gpu_by_its_number(device: str, index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(DeviceBackend, "of_gpu", asked.append)
    chosen_backend(device, 1)
    assert asked == [index]


def test_a_gpu_that_cannot_be_used_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(index: int) -> None:
        raise DeviceError("No NVRTC library was found.")

    monkeypatch.setattr(device_backend, "device_kernels", missing)
    with pytest.raises(DeviceError, match="NVRTC"):
        chosen_backend("cuda:0", 1)


@pytest.mark.gpu
def test_the_gpu_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    if not torch.cuda.is_available():
        pytest.skip("There is no GPU.")
    found = chosen_backend("cuda:0", 1)
    assert isinstance(found, DeviceBackend)
    assert (found.name, found.device) == ("cuda:0", torch.device("cuda", 0))
