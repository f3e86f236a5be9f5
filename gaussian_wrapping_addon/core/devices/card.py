# SPDX-License-Identifier: GPL-3.0-or-later
"""Facts about the GPUs of this machine, for the doctor. Worker only: loads torch."""

from __future__ import annotations

import ctypes
import sys

from ..errors import DeviceError
from ..render.cuda.driver import driver_cuda_version
from .choice import AUTO, choose_device

_GIB = 2**30
_TEXT_BYTES = 96


def gpu_findings() -> list[tuple[str, str]]:
    """Return subject and finding: what jobs of the setting ``auto`` use, and the GPUs there are.

    Without a usable GPU the first and only finding says why.
    """
    chosen = choose_device(AUTO)
    if not chosen.is_cuda:
        return [("Device", f"jobs run on the processor: {chosen.reason}")]
    import torch

    from ..render.cuda.kernels import nvrtc_of_torch

    found = [("Device", f"{chosen.card} ({chosen.device}); the test of its kernels passed")]
    for index in range(torch.cuda.device_count()):
        free_bytes, total_bytes = torch.cuda.mem_get_info(index)
        major, minor = torch.cuda.get_device_capability(index)
        memory = f"{free_bytes / _GIB:.1f} of {total_bytes / _GIB:.1f} GiB free"
        name = torch.cuda.get_device_name(index)
        found.append((f"GPU {index}", f"{name}, compute capability {major}.{minor}, {memory}"))
    library = nvrtc_of_torch()
    found.append(("NVRTC", library.name if library is not None else "not found"))
    return [*found, ("GPU driver", _driver())]


def _driver() -> str:
    """Return the driver's version and the newest CUDA that it supports."""
    try:
        cuda = f"supports CUDA {driver_cuda_version()}"
    except DeviceError as error:  # it has just rendered, so this is not expected
        return error.message
    number = _driver_number()
    return f"{number}, {cuda}" if number else cuda


def _driver_number() -> str:
    """Return the version as NVIDIA numbers its drivers; empty where NVML does not tell."""
    name = "nvml.dll" if sys.platform == "win32" else "libnvidia-ml.so.1"
    text = ctypes.create_string_buffer(_TEXT_BYTES)
    try:
        nvml = ctypes.CDLL(name)
        if nvml.nvmlInit_v2() != 0:
            return ""
        failed = nvml.nvmlSystemGetDriverVersion(text, ctypes.c_uint(_TEXT_BYTES))
        nvml.nvmlShutdown()
    except (OSError, AttributeError):  # AttributeError: a library of that name that is not NVML
        return ""
    return "" if failed else text.value.decode(errors="replace")
