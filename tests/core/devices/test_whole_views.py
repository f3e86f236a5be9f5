# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole views on a GPU, and on the processor where the GPU fails."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from gaussian_wrapping_addon.core.devices.checks import with_renderer
from gaussian_wrapping_addon.core.errors import Cancelled, DeviceError, ResourceError
from gaussian_wrapping_addon.core.render.cuda import device_renderer
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer


class OnGpu:
    """Stands for the renderer of a GPU."""

    def __init__(self, device: str) -> None:
        self.device, self.released = device, False

    def render(self, *_: object) -> Any:
        raise AssertionError("nothing is rendered here")

    def release(self) -> None:
        self.released = True


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[OnGpu]:
    """Return the renderers of GPUs that are asked for."""
    renderers: list[OnGpu] = []

    def device_renderer_of(device: str) -> OnGpu:
        renderers.append(OnGpu(device))
        return renderers[-1]

    monkeypatch.setattr(device_renderer, "device_renderer", device_renderer_of)
    return renderers


def test_the_processor_and_a_gpu_render_where_they_are_asked_to(made: list[OnGpu]) -> None:
    assert isinstance(with_renderer("cpu", "Views", lambda renderer: renderer), ViewRenderer)
    assert made == []
    assert with_renderer("cuda:1", "Views", lambda renderer: renderer) is made[0]
    assert (made[0].device, made[0].released) == ("cuda:1", True)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (DeviceError("The launch failed.", ""), "The launch failed."),
        (ResourceError("One row does not fit.", ""), "One row does not fit."),
        (torch.OutOfMemoryError("Out of memory.\nTried to allocate"), "Out of memory."),
        (RuntimeError("CUDA error: an illegal access"), "CUDA error: an illegal access"),
    ],
)
def test_what_fails_on_the_gpu_is_done_again_on_the_processor(
    error: Exception, reason: str, made: list[OnGpu], caplog: pytest.LogCaptureFixture
) -> None:
    asked = []

    def work(renderer: Any) -> str:
        asked.append(type(renderer))
        if isinstance(renderer, OnGpu):
            raise error
        return "done"

    assert with_renderer("cuda:0", "Views", work) == "done"
    assert asked == [OnGpu, ViewRenderer]
    assert made[0].released
    assert caplog.messages == [f"Views are rendered on the processor, not on the GPU: {reason}"]


def test_a_gpu_without_kernels_is_a_reason_too(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def absent(device: str) -> OnGpu:
        raise DeviceError("No NVRTC library was found.", "")

    monkeypatch.setattr(device_renderer, "device_renderer", absent)
    assert isinstance(with_renderer("cuda:0", "Views", lambda renderer: renderer), ViewRenderer)
    assert caplog.messages == [
        "Views are rendered on the processor, not on the GPU: No NVRTC library was found."
    ]


@pytest.mark.parametrize("error", [Cancelled(), ValueError("wrong"), RuntimeError("a shape")])
def test_other_errors_are_not_the_gpus(error: Exception, made: list[OnGpu]) -> None:
    def work(renderer: Any) -> None:
        raise error

    with pytest.raises(type(error)):
        with_renderer("cuda:0", "Views", work)
    assert made[0].released
