# SPDX-License-Identifier: GPL-3.0-or-later
"""The backend of a chosen device."""

from __future__ import annotations

import logging

from ...devices.failures import is_device_failure
from ...errors import WrapError
from .backend import Backend
from .cpu_backend import CpuBackend

_logger = logging.getLogger(__name__)


def chosen_backend(device: str, threads: int, *, or_processor: bool = False) -> Backend:
    """Return the backend of a device.

    Parameters
    ----------
    device : str
        "cpu", or a GPU such as "cuda:0".
    threads : int
        Of the processor.
    or_processor : bool
        Return the processor's where the GPU fails, and log why.

    Raises
    ------
    DeviceError
        If the GPU's compiler or driver is missing or fails.
    """
    if device == "cpu":
        return CpuBackend(threads)
    from .device_backend import DeviceBackend  # the processor needs none of it

    try:
        return DeviceBackend.of_gpu(int(device.partition(":")[2] or 0))
    except (WrapError, RuntimeError) as error:
        if not (or_processor and is_device_failure(error)):
            raise
        _logger.warning("%s failed (%s): training on the processor", device, error)
        return CpuBackend(threads)
