# SPDX-License-Identifier: GPL-3.0-or-later
"""LPIPS by its package, which is not installed here: a module of its name stands for it."""

from __future__ import annotations

import importlib.machinery
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.image_metrics import Lpips, lpips_if_ready, lpips_ready


class Network:
    """Mean distance of what the package's network gets; as the package, it wants [-1, 1]."""

    def __init__(self, **keywords: Any) -> None:
        assert keywords == {"net": "alex", "version": "0.1", "verbose": False}

    def eval(self) -> Network:
        return self

    def __call__(self, a: torch.Tensor, b: torch.Tensor, normalize: bool) -> torch.Tensor:
        assert normalize  # of [0, 1]
        assert a.shape == b.shape == (1, 3, 40, 52)
        return (a - b).abs().mean().reshape(1, 1, 1, 1)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Package, torchvision and a file of AlexNet's weights, as they are looked for."""
    modules = [ModuleType(name) for name in ("lpips", "torchvision")]
    for module in modules:
        module.__spec__ = importlib.machinery.ModuleSpec(module.__name__, None)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    modules[0].LPIPS = Network  # type: ignore[attr-defined]
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    (tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth").touch()
    return modules[0]


@pytest.mark.usefixtures("installed")
def test_pictures_reach_the_network_in_its_colours() -> None:
    assert lpips_ready() == (True, "")
    metric, reason = lpips_if_ready()
    assert metric is not None
    assert reason == ""
    photo = np.random.default_rng(1).integers(0, 256, (40, 52, 3), dtype=np.uint8)
    assert metric.distance(photo, photo) == 0.0
    floats = photo.astype(np.float32) / 255
    expected = np.abs(floats - np.clip(floats + 0.25, 0, 1)).mean()  # clamped as by a display
    assert metric.distance(floats + 0.25, photo) == pytest.approx(expected, rel=1e-5)
    assert Lpips.fits((31, 31, 3))
    assert not Lpips.fits((30, 90, 3))


@pytest.mark.parametrize("lacking", ["lpips", "torchvision", "alexnet-owt"])
def test_what_is_missing_is_a_reason_not_an_error(
    lacking: str, installed: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, lacking, raising=False)
    monkeypatch.setattr(sys, "meta_path", [])
    if lacking == "alexnet-owt":
        monkeypatch.setenv("TORCH_HOME", str(tmp_path / "elsewhere"))
    ready, reason = lpips_ready()
    assert not ready
    assert lacking in reason
    assert lpips_if_ready() == (None, reason)


def test_a_package_that_fails_is_a_reason_too(
    installed: ModuleType, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(**keywords: Any) -> None:
        raise RuntimeError("operator torchvision::nms does not exist\nmore")

    installed.LPIPS = broken  # type: ignore[attr-defined]
    metric, reason = lpips_if_ready()
    assert metric is None
    assert reason == "LPIPS is not measured: operator torchvision::nms does not exist"
    assert reason in caplog.messages
