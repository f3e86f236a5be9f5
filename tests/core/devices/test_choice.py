# SPDX-License-Identifier: GPL-3.0-or-later
"""Which device a setting stands for, and what is said where it is not the GPU."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from gaussian_wrapping_addon.core.devices import (
    DeviceChoice,
    checks,
    choice,
    choose_device,
    reject_absent_gpu,
    stage_device,
)
from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, DeviceError
from gaussian_wrapping_addon.core.render.cuda import compiler, kernels

REPOSITORY = Path(__file__).resolve().parents[3]
GIB = 1 << 30


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    """Forget what was found out about GPUs, before and after."""
    choice._usable.cache_clear()
    yield
    choice._usable.cache_clear()


@pytest.fixture
def two_gpus(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Stand in for a machine with two GPUs, of 2 and 6 GiB free; return which were tested."""
    tested: list[int] = []

    def passes(index: int) -> str:
        tested.append(index)
        return ""

    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: f"Card {index}")
    free = {0: 2 * GIB, 1: 6 * GIB}
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: (free[index], 8 * GIB))
    monkeypatch.setattr(kernels, "find_nvrtc", lambda major: Path(f"libnvrtc.so.{major}"))
    monkeypatch.setattr(kernels, "load_driver", lambda: None)
    monkeypatch.setattr(checks, "failure_on", passes)
    return tested


def test_the_processor_is_taken_where_it_is_asked_for(two_gpus: list[int]) -> None:
    assert choose_device("cpu") == DeviceChoice("cpu", "", "The setting asks for it.")
    assert two_gpus == []


@pytest.mark.parametrize(
    ("setting", "device"),
    [("auto", "cuda:0"), ("cuda", "cuda:0"), ("cuda:0", "cuda:0"), ("cuda:1", "cuda:1")],
)
def test_a_gpu_that_passes_is_taken(two_gpus: list[int], setting: str, device: str) -> None:
    found = [choose_device(setting) for _ in range(2)]
    number = int(device[-1])
    reason = f"Card {number}, kernels compiled by libnvrtc.so.13."
    assert found == [DeviceChoice(device, f"Card {number}", reason)] * 2
    assert two_gpus == [number], "it is tested once"
    assert found[0].sentence() == f"Card {number} ({device}): {reason}"


def no_driver() -> None:
    raise DeviceError("There is no driver here.")


STEPS = {
    "built without CUDA": lambda patch: patch.setattr(torch.version, "cuda", None),
    "finds no CUDA device": lambda patch: patch.setattr(torch.cuda, "is_available", lambda: False),
    "No NVRTC library": lambda patch: patch.setattr(kernels, "find_nvrtc", lambda major: None),
    "no driver here": lambda patch: patch.setattr(kernels, "load_driver", no_driver),
    "renders another depth": lambda patch: patch.setattr(
        checks, "failure_on", lambda index: "The GPU renders another depth."
    ),
}  # fmt: skip


@pytest.mark.usefixtures("two_gpus")
@pytest.mark.parametrize("reason", STEPS)
def test_a_gpu_that_cannot_be_used_is_left_with_the_reason_or_refused(
    reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    STEPS[reason](monkeypatch)
    found = choose_device("auto")
    assert (found.device, found.card, found.is_cuda) == ("cpu", "", False)
    assert reason in found.reason
    assert found.sentence() == f"processor: {found.reason}"
    assert "\n" not in found.reason
    for setting in ("cuda", "cuda:0"):
        with pytest.raises(DeviceError, match=reason) as refused:
            choose_device(setting)
        assert refused.value.exit_code == EXIT_BAD_DATA == 3
        assert refused.value.message == f"The device {setting} cannot be used: {found.reason}"
        assert "auto or cpu" in refused.value.hint


@pytest.mark.usefixtures("two_gpus")
@pytest.mark.parametrize("function", ["get_device_name", "mem_get_info", "is_available"])
@pytest.mark.parametrize("error", [RuntimeError("CUDA driver error\nmore"), OSError(5, "broken")])
def test_a_driver_that_breaks_while_asked_is_a_reason_too(
    function: str, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise error

    monkeypatch.setattr(torch.cuda, function, broken)
    found = choose_device("auto", 1)
    assert (found.device, found.card) == ("cpu", "")
    assert found.reason == f"The GPU does not respond: {str(error).splitlines()[0]}."
    with pytest.raises(DeviceError, match="The device cuda cannot be used: The GPU does not"):
        choose_device("cuda", 1)


@pytest.mark.usefixtures("two_gpus")
def test_a_gpu_that_is_not_there_is_refused() -> None:
    with pytest.raises(DeviceError, match="no GPU 2: PyTorch finds 2, counted from 0"):
        choose_device("cuda:2")


@pytest.mark.usefixtures("two_gpus")
def test_what_does_not_fit_into_the_free_memory_is_not_begun_there() -> None:
    assert choose_device("auto", 2 * GIB).device == "cuda:0"
    small = choose_device("auto", 2 * GIB + 1)
    assert small.device == "cpu"
    assert small.reason == "2.0 GiB of the GPU's memory are free, 2.0 GiB are needed."
    assert choose_device("cuda:1", 3 * GIB).device == "cuda:1"
    with pytest.raises(DeviceError, match=r"2\.0 GiB .* are free, 3\.0 GiB are needed"):
        choose_device("cuda", 3 * GIB)


@pytest.mark.usefixtures("two_gpus")
def test_a_stage_leaves_the_gpu_where_it_does_not_fit(caplog: pytest.LogCaptureFixture) -> None:
    chosen = choose_device("auto")
    assert stage_device(chosen, "auto", GIB, "Vacancy") == chosen
    assert caplog.messages == []
    assert stage_device(chosen, "auto", 3 * GIB, "Vacancy").device == "cpu"
    (line,) = caplog.messages
    assert line.startswith("Vacancy runs on the processor, not on the GPU: 2.0 GiB")
    processor = choose_device("cpu")
    assert stage_device(processor, "cuda", 99 * GIB, "Vacancy") == processor
    with pytest.raises(DeviceError, match=r"3\.0 GiB are needed"):
        stage_device(chosen, "cuda", 3 * GIB, "Vacancy")


class _Driver:
    """A driver that shows some GPUs."""

    def __init__(self, count: int) -> None:
        self.count = count

    def cuDeviceGetCount(self, found: ctypes.c_int) -> int:  # noqa: N802 - its name
        found._obj.value = self.count  # type: ignore[attr-defined]
        return 0


def test_the_driver_alone_refuses_a_gpu_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiler, "load_driver", lambda: _Driver(2))
    for setting in ("auto", "cpu", "cuda", "cuda:0", "cuda:1"):
        reject_absent_gpu(setting)
    with pytest.raises(DeviceError, match="The device cuda:2 cannot be used: the driver finds 2"):
        reject_absent_gpu("cuda:2")

    def missing() -> None:
        raise DeviceError("The NVIDIA driver library x was not found.", "Update it.")

    monkeypatch.setattr(compiler, "load_driver", missing)
    reject_absent_gpu("auto")
    with pytest.raises(DeviceError, match="driver library x was not found") as refused:
        reject_absent_gpu("cuda")
    assert refused.value.exit_code == EXIT_BAD_DATA


def test_asking_the_driver_loads_no_torch() -> None:
    code = (
        "import sys\n"
        f"sys.path.insert(0, {str(REPOSITORY)!r})\n"
        "from gaussian_wrapping_addon.core import devices, errors\n"
        "try:\n"
        "    devices.reject_absent_gpu('cuda:999')\n"
        "except errors.DeviceError:\n"
        "    print(sorted({'torch', 'numba', 'numpy'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, check=False)
    assert done.stdout.decode().strip() == "[]", done.stderr.decode()
