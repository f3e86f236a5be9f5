# SPDX-License-Identifier: GPL-3.0-or-later
"""Launch CUDA kernels by name with torch tensors as arguments; check CUDA availability."""

from __future__ import annotations

import ctypes
import functools
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...errors import DeviceError
from ..projection.projection_kernels import CAMERA_VALUES
from .compiler import compile_text, find_nvrtc
from .driver import DriverModule, load_driver
from .source import KERNELS, THREADS_PER_BLOCK, cuda_source


class CameraValues(ctypes.Structure):
    """A packed camera, passed to kernels by value."""

    _fields_ = [("v", ctypes.c_double * CAMERA_VALUES)]

    @classmethod
    def of(cls, packed: np.ndarray) -> CameraValues:
        """Copy what ``pack_camera`` returned."""
        return cls.from_buffer_copy(np.ascontiguousarray(packed, np.float64).tobytes())


Argument = Tensor | int | float | CameraValues | ctypes.c_double


class Kernels(ABC):
    """Runs the kernels of the CUDA source on tensors of one device."""

    def launch(self, name: str, blocks: int, *arguments: Argument) -> None:
        """Run a kernel with :data:`THREADS_PER_BLOCK` threads per block; 0 blocks do nothing.

        Tensors must be contiguous and are passed by address; integers are passed as ``int``, other
        numbers as ``float``, but a ``c_double`` as ``double``.
        """
        if blocks == 0:
            return
        values = [_value(argument) for argument in arguments]
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        self._run(name, blocks, pointers)

    def launch_each(self, name: str, count: int, *arguments: Argument) -> None:
        """Run a kernel with one thread per item; ``count`` is its first argument."""
        self.launch(name, -(-count // THREADS_PER_BLOCK), count, *arguments)

    @abstractmethod
    def _run(self, name: str, blocks: int, parameters: ctypes.Array) -> None: ...


class DeviceKernels(Kernels):
    """The kernels, compiled for and run on one GPU."""

    def __init__(self, device_index: int) -> None:
        library = nvrtc_of_torch()
        if library is None:
            raise DeviceError("No NVRTC library was found.", _NO_NVRTC_HINT)
        capability = torch.cuda.get_device_capability(device_index)
        compiled = compile_text(cuda_source(), capability, library)
        self._device_index = device_index
        self._module = DriverModule(device_index, compiled.image, KERNELS)

    def _run(self, name: str, blocks: int, parameters: ctypes.Array) -> None:
        stream = torch.cuda.current_stream(self._device_index).cuda_stream
        self._module.launch(name, blocks, THREADS_PER_BLOCK, parameters, stream)


_NO_NVRTC_HINT = "Install the package nvidia-cuda-nvrtc of torch's CUDA version."


@functools.cache
def device_kernels(device_index: int) -> DeviceKernels:
    """Return the kernels of a GPU, compiled on the first call of the process.

    Raises
    ------
    DeviceError
        If the compiler or the driver is missing or fails.
    """
    return DeviceKernels(device_index)


def cuda_available(device_index: int | None = None) -> tuple[bool, str]:
    """Return whether the renderer can run on a GPU of this machine, and the reason.

    Parameters
    ----------
    device_index : int, optional
        Device index of torch; by default its current device.
    """
    if torch.version.cuda is None:
        return False, "This PyTorch was built without CUDA."
    if not torch.cuda.is_available():
        return False, "PyTorch finds no CUDA device, or the driver is too old for it."
    library = nvrtc_of_torch()
    if library is None:
        return False, f"No NVRTC library was found. {_NO_NVRTC_HINT}"
    try:
        load_driver()
    except DeviceError as error:
        return False, str(error)
    count = torch.cuda.device_count()
    if device_index is not None and device_index >= count:
        return False, f"There is no GPU {device_index}: PyTorch finds {count}, counted from 0."
    name = torch.cuda.get_device_name(device_index)
    return True, f"{name}, kernels compiled by {library.name}."


def nvrtc_of_torch() -> Path | None:
    """Return the NVRTC library for torch's version of CUDA; ``None`` where there is none."""
    return find_nvrtc(int(torch.version.cuda.split(".")[0]) if torch.version.cuda else None)


def _value(argument: Argument) -> ctypes._SimpleCData | ctypes.Structure:
    if isinstance(argument, Tensor):
        assert argument.is_contiguous()
        return ctypes.c_void_p(argument.data_ptr())
    if isinstance(argument, (CameraValues, ctypes.c_double)):
        return argument
    if isinstance(argument, (int, np.integer)):
        return ctypes.c_int(int(argument))
    return ctypes.c_float(argument)
