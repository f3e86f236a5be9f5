# SPDX-License-Identifier: GPL-3.0-or-later
"""The test of a GPU's kernels passes right ones and names what wrong ones give."""

from __future__ import annotations

import ctypes
from pathlib import Path

import pytest
import torch

from gaussian_wrapping_addon.core.devices import checks
from gaussian_wrapping_addon.core.devices.checks import check_kernels, failure_on
from gaussian_wrapping_addon.core.errors import DeviceError, ResourceError
from gaussian_wrapping_addon.core.render.cuda.kernels import cuda_available, cuda_source
from tests.core.render.cuda.emulation import EmulatedKernels, build_emulator

CPU = torch.device("cpu")


@pytest.mark.parametrize("ulp", [0.0, 1.0, -1.0])
def test_the_kernels_pass(
    ulp: float, emulator_library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "TOLERANCE", checks.TOLERANCE / 10)  # with room
    assert check_kernels(EmulatedKernels(emulator_library, ulp=ulp), CPU) == ""


@pytest.mark.parametrize(
    ("skipped", "told"),
    [
        ("forward_tiles", "renders another color"),
        ("isosurface_tiles", "renders another depth"),
        ("backward_tiles_depth", "another gradient of means"),
        ("project_backward", "another gradient of means"),
    ],
)
def test_a_kernel_that_does_nothing_is_noticed(
    skipped: str, told: str, emulator_library: Path
) -> None:
    class Skipping(EmulatedKernels):
        def _run(self, name: str, blocks: int, parameters: ctypes.Array) -> None:
            if name != skipped:
                super()._run(name, blocks, parameters)

    assert told in check_kernels(Skipping(emulator_library), CPU)


def test_wrong_arithmetic_is_noticed(tmp_path: Path) -> None:
    text = cuda_source()
    assert text.count("#define ALPHA_MAX 0.99f") == 1
    wrong = text.replace("#define ALPHA_MAX 0.99f", "#define ALPHA_MAX 0.5f")
    library = build_emulator(tmp_path, wrong)
    assert "renders another" in check_kernels(EmulatedKernels(library), CPU)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (DeviceError("NVRTC rejected the kernels.", "Report it."), "NVRTC rejected the kernels."),
        (ResourceError("No room."), "No room."),
        (
            RuntimeError("CUDA error: no kernel image\nCUDA kernel errors might be"),
            "The test of the GPU's kernels failed: CUDA error: no kernel image.",
        ),
        (RuntimeError(""), "The test of the GPU's kernels failed: no message."),
    ],
)
def test_failures_are_sentences(
    error: Exception, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_index: int) -> None:
        raise error

    monkeypatch.setattr(checks, "device_kernels", fails)
    assert failure_on(0) == told


@pytest.mark.gpu
def test_a_gpu_passes() -> None:
    usable, reason = cuda_available()
    if not usable:
        pytest.skip(reason)
    assert failure_on(0) == ""
