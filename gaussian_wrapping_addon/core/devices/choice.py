# SPDX-License-Identifier: GPL-3.0-or-later
"""Choose the device of a job by its setting; say why where it is not the GPU."""

from __future__ import annotations

import functools
import logging
from dataclasses import dataclass

from ..errors import DeviceError
from ..render.cuda.driver import device_count

_logger = logging.getLogger(__name__)

CPU = "cpu"
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
    rendering on it is right, and ``needed_bytes`` are free. All but the free memory is looked at
    once per process.

    Parameters
    ----------
    setting : str
        ``"auto"``, ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
    needed_bytes : int
        Memory of the GPU that the work takes in addition to what is in use.

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

    Parameters
    ----------
    chosen : DeviceChoice
        The job's.
    setting : str
        That it was chosen by.
    needed_bytes : int
        As for :func:`choose_device`.
    what : str
        What runs there, for the log.

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
    from .kernel_check import failure_on

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
