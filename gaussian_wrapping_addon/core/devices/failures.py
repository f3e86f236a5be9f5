# SPDX-License-Identifier: GPL-3.0-or-later
"""Tell a device's failures from others: what another device, or less memory, would not have met."""

from __future__ import annotations

import torch

from ..errors import DeviceError, ResourceError

_WORDS = ("CUDA error", "CUDA driver", "cuBLAS", "CUBLAS")
"""What torch's messages of a failing driver or library contain, whatever their type."""


def is_memory_failure(error: Exception) -> bool:
    """Return whether a device's memory did not suffice."""
    return isinstance(error, (ResourceError, torch.OutOfMemoryError))


def is_device_failure(error: Exception) -> bool:
    """Return whether the device failed: its memory, its driver or its compiler."""
    if is_memory_failure(error) or isinstance(error, DeviceError):
        return True
    return isinstance(error, RuntimeError) and any(word in str(error) for word in _WORDS)
