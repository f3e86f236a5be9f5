# SPDX-License-Identifier: GPL-3.0-or-later
"""What the doctor tells of GPUs, with stand-ins for torch and the driver."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gaussian_wrapping_addon.core.devices import choice
from gaussian_wrapping_addon.core.devices.choice import DeviceChoice, gpu_findings
from gaussian_wrapping_addon.core.errors import DeviceError
from gaussian_wrapping_addon.core.jobs.commands import doctor
from gaussian_wrapping_addon.core.render.cuda import compiler, kernels

GIB = 1 << 30


def test_without_a_gpu_one_line_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = DeviceChoice("cpu", "", "There is no driver.")
    monkeypatch.setattr(choice, "choose_device", lambda setting: chosen)
    assert gpu_findings() == [("Device", "jobs run on the processor: There is no driver.")]


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = DeviceChoice("cuda:0", "Card 0", "It passed.")
    monkeypatch.setattr(choice, "choose_device", lambda setting: chosen)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: f"Card {index}")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (9, index))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: (3 * GIB, 8 * GIB))
    monkeypatch.setattr(kernels, "find_nvrtc", lambda major: Path("x/libnvrtc.so.13"))


@pytest.mark.usefixtures("gpu")
def test_all_that_is_known_of_the_gpus_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    class Driver:
        def cuDriverGetVersion(self, found):  # type: ignore[no-untyped-def]  # noqa: N802
            found._obj.value = 12080
            return 0

    class Nvml:
        def nvmlInit_v2(self) -> int:  # noqa: N802
            return 0

        def nvmlSystemGetDriverVersion(self, text, size):  # type: ignore[no-untyped-def]  # noqa: N802
            text.value = b"570.86.15"
            assert size.value == len(text)
            return 0

        def nvmlShutdown(self) -> int:  # noqa: N802
            return 0

    monkeypatch.setattr(compiler, "load_driver", Driver)
    monkeypatch.setattr(choice.ctypes, "CDLL", lambda name: Nvml())
    expected = [
        ("Device", "Card 0 (cuda:0); the test of its kernels passed"),
        ("GPU 0", "Card 0, compute capability 9.0, 3.0 of 8.0 GiB free"),
        ("GPU 1", "Card 1, compute capability 9.1, 3.0 of 8.0 GiB free"),
        ("NVRTC", "libnvrtc.so.13"),
        ("GPU driver", "570.86.15, supports CUDA 12.8"),
    ]
    assert gpu_findings() == expected
    found = doctor.diagnose()
    told = [(f.subject, f.finding) for f in found if (f.subject, f.finding) in expected]
    assert told == expected
    assert all(f.good for f in found if f.subject in dict(expected))


@pytest.mark.usefixtures("gpu")
def test_without_nvml_the_driver_is_told_by_its_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(choice.ctypes, "CDLL", missing)
    monkeypatch.setattr(choice, "driver_cuda_version", lambda: "13.0")
    assert gpu_findings()[-1] == ("GPU driver", "supports CUDA 13.0")


def test_the_doctor_survives_a_broken_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(setting: str) -> None:
        raise DeviceError("The driver is broken.")

    monkeypatch.setattr(choice, "choose_device", broken)
    (found,) = doctor._devices()
    assert (found.good, found.finding) == (True, "jobs run on the processor: The driver is broken.")
