# SPDX-License-Identifier: GPL-3.0-or-later
"""The device of a job, chosen by its setting."""

from __future__ import annotations

import ctypes
import functools
import logging
import sys
from dataclasses import dataclass

from ..errors import DeviceError
from ..names import CPU
from ..render.cuda.compiler import device_count, driver_cuda_version

# -- Choose the device of a job by its setting; say why where it is not the GPU -------------------

_logger = logging.getLogger(__name__)

AUTO = "auto"
CUDA = "cuda"
_HINT = "Give the device auto or cpu to go on with the processor; batch.py doctor shows the rest."


@dataclass(frozen=True)
class DeviceChoice:
    """Where a job computes, and why."""

    device: str
    """``"cpu"`` or ``"cuda:N"``, as torch names it."""
    card: str
    """Name of the GPU; empty for the processor."""
    reason: str
    """A sentence."""

    @property
    def is_cuda(self) -> bool:
        """Whether it is a GPU."""
        return self.device != CPU

    def sentence(self) -> str:
        """Return device and reason in one line."""
        where = f"{self.card} ({self.device})" if self.is_cuda else "processor"
        return f"{where}: {self.reason}"


def choose_device(setting: str, needed_bytes: int = 0) -> DeviceChoice:
    """Return the device that a setting stands for on this machine. Worker only: loads torch.

    A GPU is taken where torch is built for CUDA, the driver responds, NVRTC is found, a small
    rendering on it is right, and ``needed_bytes``, in addition to what is in use, are free. All but
    the free memory is looked at once per process. Settings are ``"auto"``, ``"cpu"``, ``"cuda"``,
    ``"cuda:N"``.

    Raises
    ------
    DeviceError
        The setting names a GPU, and it cannot be used.
    """
    if setting == CPU:
        return DeviceChoice(CPU, "", "The setting asks for it.")
    index = _index(setting)
    try:
        usable, found = _usable(index)
        reason = "" if usable else found
        if usable and needed_bytes:
            reason = _shortage(index, needed_bytes)
        if not reason:
            return DeviceChoice(f"{CUDA}:{index}", _card(index), found)
    except (RuntimeError, OSError) as error:  # of torch, where the driver is broken
        lines = str(error).strip().splitlines()
        reason = f"The GPU does not respond: {lines[0] if lines else type(error).__name__}."
    if setting == AUTO:
        return DeviceChoice(CPU, "", reason)
    raise DeviceError(f"The device {setting} cannot be used: {reason}", _HINT)


def stage_device(chosen: DeviceChoice, setting: str, needed_bytes: int, what: str) -> DeviceChoice:
    """Return the job's device, or the processor where a stage does not fit into its GPU.

    ``chosen`` is the job's, by ``setting``; ``what`` is what runs there, for the log.

    Raises
    ------
    DeviceError
        The setting names a GPU that has too little free memory.
    """
    if not chosen.is_cuda:
        return chosen
    fitting = choose_device(setting, needed_bytes)
    if fitting.device != chosen.device:
        _logger.warning("%s runs on the processor, not on the GPU: %s", what, fitting.reason)
    return fitting


def reject_absent_gpu(setting: str) -> None:
    """Raise at once where a setting names a GPU and the driver has none; loads no torch.

    Raises
    ------
    DeviceError
        There is no driver, or no such GPU.
    """
    if not setting.startswith(CUDA):
        return
    try:
        count = device_count()
    except DeviceError as error:
        raise DeviceError(f"The device {setting} cannot be used: {error.message}", _HINT) from None
    if _index(setting) >= count:
        raise DeviceError(
            f"The device {setting} cannot be used: the driver finds {count}, counted from 0.", _HINT
        )


def _index(setting: str) -> int:
    return int(setting.partition(":")[2] or 0)


@functools.cache
def _usable(index: int) -> tuple[bool, str]:
    """Return whether a GPU gives right results, and the reason."""
    import torch

    if torch.version.cuda is None:  # known without the kernels, whose import takes a second
        return False, (
            "This PyTorch was built without CUDA; Set Up Worker offers the build with it where "
            "there is an NVIDIA driver."
        )
    from ..render.cuda.kernels import cuda_available
    from .checks import failure_on

    usable, reason = cuda_available(index)
    failure = failure_on(index) if usable else ""
    return (False, failure) if failure else (usable, reason)


def _card(index: int) -> str:
    import torch

    return str(torch.cuda.get_device_name(index))


def _shortage(index: int, needed_bytes: int) -> str:
    """Return why work does not fit into the free memory of a GPU; empty where it does."""
    import torch

    free_bytes = torch.cuda.mem_get_info(index)[0]
    if needed_bytes <= free_bytes:
        return ""
    return (
        f"{free_bytes / 2**30:.1f} GiB of the GPU's memory are free, "
        f"{needed_bytes / 2**30:.1f} GiB are needed."
    )


# -- Facts about the GPUs of this machine, for the doctor. Worker only: loads torch ---------------

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
