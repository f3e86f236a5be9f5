# SPDX-License-Identifier: GPL-3.0-or-later
"""Calls to the CUDA driver, recorded by a mock: order, contexts, arguments, errors."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import pytest
import torch

from gaussian_wrapping_addon.core.errors import DeviceError
from gaussian_wrapping_addon.core.render.cuda import compiler
from gaussian_wrapping_addon.core.render.cuda.compiler import DriverModule
from gaussian_wrapping_addon.core.render.cuda.kernels import Argument, Kernels


class FakeDriver:
    """Notes calls; fails in the function named ``fails`` from when it is set."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, tuple]] = []
        self.fails = ""
        self.depth = 0

    def __getattr__(self, name: str) -> Callable[..., int]:
        def call(*arguments: object) -> int:
            self.calls.append((name, arguments))
            self.depth += {"cuCtxPushCurrent_v2": 1, "cuCtxPopCurrent_v2": -1}.get(name, 0)
            if name == "cuGetErrorString":
                arguments[1]._obj.value = b"out of order"  # type: ignore[attr-defined]
            return 700 if name == self.fails else 0

        return call


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeDriver:
    found = FakeDriver()
    monkeypatch.setattr(compiler, "load_driver", lambda: found)
    return found


def test_kernels_are_loaded_and_launched_in_the_primary_context(fake: FakeDriver) -> None:
    module = DriverModule(1, b"image\0more", ["probe", "other"])
    assert [name for name, _ in fake.calls] == [
        "cuDeviceGet", "cuDevicePrimaryCtxRetain", "cuCtxPushCurrent_v2", "cuModuleLoadDataEx",
        "cuModuleGetFunction", "cuModuleGetFunction", "cuCtxPopCurrent_v2",
    ]  # fmt: skip
    assert fake.calls[0][1][1] == 1
    assert fake.calls[3][1][1] == b"image\0more"
    fake.calls.clear()
    parameters = (ctypes.c_void_p * 1)()
    module.launch("probe", 7, 256, parameters, 99)
    assert [name for name, _ in fake.calls] == [
        "cuCtxPushCurrent_v2", "cuLaunchKernel", "cuCtxPopCurrent_v2",
    ]  # fmt: skip
    _, *grid, stream, given, extra = fake.calls[1][1]
    assert [value.value for value in grid] == [7, 1, 1, 256, 1, 1, 0]
    assert stream.value == 99
    assert given is parameters
    assert extra is None


@pytest.mark.parametrize("function", ["cuModuleLoadDataEx", "cuModuleGetFunction"])
def test_errors_are_typed_and_leave_the_context(fake: FakeDriver, function: str) -> None:
    fake.fails = function
    with pytest.raises(DeviceError, match=rf"{function} .* failed: out of order \(700\)"):
        DriverModule(0, b"", ["probe"])
    assert fake.depth == 0
    fake.fails = ""
    module = DriverModule(0, b"", ["probe"])
    fake.fails = "cuLaunchKernel"
    with pytest.raises(DeviceError, match="cuLaunchKernel"):
        module.launch("probe", 1, 256, (ctypes.c_void_p * 0)(), 0)
    assert fake.depth == 0


def test_arguments_are_passed_as_pointers_to_their_values() -> None:
    seen = []

    class Reading(Kernels):
        def _run(self, name: str, blocks: int, parameters: ctypes.Array) -> None:
            types = (ctypes.c_int, ctypes.c_void_p, ctypes.c_float)
            values = [
                ctypes.cast(pointer, ctypes.POINTER(kind))[0]
                for pointer, kind in zip(parameters, types, strict=True)
            ]
            seen.append((name, blocks, *values))

    tensor = torch.zeros(3)
    arguments: tuple[Argument, ...] = (tensor, 0.5)
    Reading().launch_each("probe", 257, *arguments)
    Reading().launch_each("probe", 0, *arguments)
    assert seen == [("probe", 2, 257, tensor.data_ptr(), 0.5)]
    with pytest.raises(AssertionError):
        Reading().launch("probe", 1, torch.zeros((2, 2)).T)
