# SPDX-License-Identifier: GPL-3.0-or-later
"""Kernels for tests that run emulated on the host and, where there is one, on a GPU."""

from __future__ import annotations

import pytest

from gaussian_wrapping_addon.core.render.cuda.kernels import Kernels, cuda_available, device_kernels

DEVICES = ["emulated", pytest.param("cuda", marks=pytest.mark.gpu)]
"""Values of a parameter ``device`` of a test."""


def kernels_of(device: str, request: pytest.FixtureRequest) -> Kernels:
    """Return the kernels of a device; skip the test where there is none."""
    if device == "cuda":
        usable, reason = cuda_available()
        if not usable:
            pytest.skip(reason)
        return device_kernels(0)
    from tests.core.render.cuda.emulation import EmulatedKernels

    return EmulatedKernels(request.getfixturevalue("emulator_library"))
