# SPDX-License-Identifier: GPL-3.0-or-later
"""Load and launch kernels through the CUDA driver API (ctypes).

Kernels run in the device's primary context, which torch uses as well, so they can access torch's
memory and use its streams.
"""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Sequence

from ...errors import DeviceError

_HINT = "Update the NVIDIA driver, or render on the CPU."


class DriverModule:
    """Compiled kernels loaded into the primary context of one GPU.

    Parameters
    ----------
    device_index : int
        Device index of torch.
    image : bytes
        From the compiler.
    names : sequence of str
        Kernels to look up.

    Raises
    ------
    DeviceError
        If the driver is missing or fails.
    """

    def __init__(self, device_index: int, image: bytes, names: Sequence[str]) -> None:
        self._cuda = load_driver()
        device = ctypes.c_int()
        _check(self._cuda, "cuDeviceGet", ctypes.byref(device), device_index)
        # Never released: torch keeps the context for the life of the process.
        self._context = ctypes.c_void_p()
        _check(self._cuda, "cuDevicePrimaryCtxRetain", ctypes.byref(self._context), device)
        self._functions: dict[str, ctypes.c_void_p] = {}
        self._enter()
        try:
            module = ctypes.c_void_p()
            _check(self._cuda, "cuModuleLoadDataEx", ctypes.byref(module), image, 0, None, None)
            for name in names:
                function = ctypes.c_void_p()
                _check(
                    self._cuda,
                    "cuModuleGetFunction",
                    ctypes.byref(function),
                    module,
                    name.encode(),
                )
                self._functions[name] = function
        finally:
            self._leave()

    def launch(
        self, name: str, blocks: int, threads: int, parameters: ctypes.Array, stream: int
    ) -> None:
        """Queue a kernel; ``parameters`` points to the values of its arguments, in order.

        Raises
        ------
        DeviceError
            If it cannot be queued. Errors during execution are reported later, by torch.
        """
        self._enter()
        try:
            _check(
                self._cuda,
                "cuLaunchKernel",
                self._functions[name],
                *(ctypes.c_uint(value) for value in (blocks, 1, 1, threads, 1, 1, 0)),
                ctypes.c_void_p(stream),
                parameters,
                None,
            )
        finally:
            self._leave()

    def _enter(self) -> None:
        # The calling thread (autograd has its own) may have another context, or none.
        _check(self._cuda, "cuCtxPushCurrent_v2", self._context)

    def _leave(self) -> None:
        _check(self._cuda, "cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))


@functools.cache
def load_driver() -> ctypes.CDLL:
    """Return the NVIDIA driver library, initialised.

    Raises
    ------
    DeviceError
        If the driver is not installed.
    """
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        cuda = ctypes.CDLL(name)
    except OSError:
        raise DeviceError(f"The NVIDIA driver library {name} was not found.", _HINT) from None
    _check(cuda, "cuInit", 0)
    return cuda


def device_count() -> int:
    """Return how many GPUs the driver shows to this process; needs no torch.

    Raises
    ------
    DeviceError
        If the driver is not installed, fails, or finds no GPU.
    """
    count = ctypes.c_int()
    _check(load_driver(), "cuDeviceGetCount", ctypes.byref(count))
    return count.value


def driver_cuda_version() -> str:
    """Return the newest version of CUDA that the driver supports, such as ``"13.0"``.

    Raises
    ------
    DeviceError
        If the driver is not installed or fails.
    """
    number = ctypes.c_int()
    _check(load_driver(), "cuDriverGetVersion", ctypes.byref(number))
    return f"{number.value // 1000}.{number.value % 1000 // 10}"


def _check(cuda: ctypes.CDLL, function: str, *arguments: object) -> None:
    result = getattr(cuda, function)(*arguments)
    if result != 0:
        description = ctypes.c_char_p()
        cuda.cuGetErrorString(result, ctypes.byref(description))
        text = (description.value or b"unknown error").decode(errors="replace")
        raise DeviceError(f"{function} of the NVIDIA driver failed: {text} ({result}).", _HINT)
