# SPDX-License-Identifier: GPL-3.0-or-later
"""The renderer on a real GPU equals the CPU's; without one, it reports why it cannot run."""

from __future__ import annotations

import pytest
import torch

from gaussian_wrapping_addon.core.errors import ResourceError, UsageError
from gaussian_wrapping_addon.core.render import render as render_module
from gaussian_wrapping_addon.core.render.cuda import device_renderer, kernels
from gaussian_wrapping_addon.core.render.cuda.device_renderer import render_cuda
from gaussian_wrapping_addon.core.render.cuda.kernels import cuda_available
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.cuda.comparison import (
    IMAGES,
    STATISTICS,
    Outcome,
    assert_bitwise_equal,
    assert_same_gradients,
    assert_same_images,
    depth_weights,
    leaves,
    outcome,
    random_weights,
    relative_l2,
)
from tests.core.render.scenes import isotropic, look_at, random_gaussians

CAMERA = look_at((2.2, 1.0, 0.8), width=33, height=17)


@pytest.fixture
def gpu() -> str:
    usable, reason = cuda_available()
    if not usable:
        pytest.skip(reason)
    return "cuda"


# -- without a GPU --------------------------------------------------------------------------------


def test_the_reason_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    usable, reason = cuda_available()
    assert usable == torch.cuda.is_available()
    assert reason.endswith(".")
    monkeypatch.setattr(torch.version, "cuda", None)
    assert cuda_available() == (False, "This PyTorch was built without CUDA.")
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert cuda_available()[1].startswith("PyTorch finds no CUDA device")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(kernels, "find_nvrtc", lambda major: None)
    assert "nvidia-cuda-nvrtc" in cuda_available()[1]


def test_cpu_tensors_and_other_float_types_are_refused() -> None:
    with pytest.raises(UsageError, match="not on a GPU"):
        render_cuda(random_gaussians(3, dtype=torch.float32), CAMERA)

    with pytest.raises(UsageError, match=r"means of the Gaussians is torch.float64 on cpu"):
        device_renderer.render_with(Full(), random_gaussians(3), CAMERA, None, 1 << 20)


class Full(kernels.Kernels):
    def _run(self, name, blocks, parameters):  # type: ignore[no-untyped-def]
        raise torch.OutOfMemoryError("2 GiB asked")


def test_a_full_gpu_is_a_typed_error() -> None:
    gaussians = random_gaussians(3, dtype=torch.float32)
    with pytest.raises(ResourceError, match="memory does not suffice for view 'camera': 2 GiB"):
        device_renderer.render_with(Full(), gaussians, CAMERA, None, 1 << 20)


def test_render_hands_cuda_tensors_over(monkeypatch: pytest.MonkeyPatch) -> None:
    class OnTheGpu(torch.Tensor):
        is_cuda = True

    seen = []
    monkeypatch.setattr(render_module, "render_cuda", lambda *given: seen.append(given))
    gaussians = random_gaussians(3, dtype=torch.float32)
    gaussians = gaussians.replaced(means=gaussians.means.as_subclass(OnTheGpu))
    options = RenderOptions()
    render(gaussians, CAMERA, options)
    assert seen == [(gaussians, CAMERA, options)]


# -- with a GPU -----------------------------------------------------------------------------------


def on_both(gaussians, camera, options) -> tuple[Outcome, Outcome]:  # type: ignore[no-untyped-def]
    """Return the GPU's and the CPU's outcome for colour, normals and alpha, and their depths."""
    weights = random_weights(camera, options)
    weights.pop("depth", None)
    found = outcome(render, gaussians, camera, options, weights=weights, device="cuda")
    return found, outcome(render, gaussians, camera, options, weights=weights)


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("count", "width", "height"), [(60, 40, 30), (150, 33, 17), (3000, 320, 240), (25, 7, 5)]
)
def test_the_gpu_equals_the_cpu(gpu: str, count: int, width: int, height: int) -> None:
    gaussians = random_gaussians(count, seed=count, dtype=torch.float32)
    camera = look_at((2.2, 1.0, 0.8), width=width, height=height, focal=1.1 * width)
    options = RenderOptions(background=(0.2, 0.5, 0.1), statistics=True)
    found, wanted = on_both(gaussians, camera, options)
    assert found.render.color.device.type == gpu
    assert_same_images(found, wanted, 4e-6, decided=1e-4 if width * height > 10_000 else 0.0)
    assert_same_gradients(found, wanted)
    for name in STATISTICS:
        a = torch.as_tensor(getattr(found.render.statistics, name)).double()
        b = torch.as_tensor(getattr(wanted.render.statistics, name)).double()
        assert (a - b).abs().max() <= 1e-4 * b.abs().max(), name


@pytest.mark.gpu
def test_the_depths_gradient_on_the_gpu(gpu: str) -> None:
    gaussians = random_gaussians(80, seed=8, dtype=torch.float32, opacity=(0.3, 0.97))
    camera = look_at((2.2, 1.0, 0.8), width=48, height=40)
    options = RenderOptions()
    device = kernels.device_kernels(torch.cuda.current_device())
    weights = {
        "depth": depth_weights(device, leaves(gaussians, torch.float32, gpu), camera, options)
    }
    found = outcome(render, gaussians, camera, options, weights=weights, device=gpu)
    wanted = outcome(render, gaussians, camera, options, weights=weights)
    assert int((wanted.images["depth"] > 0).sum()) > 500
    for name in ("means", "log_scales", "quats", "opacity_logits"):
        assert relative_l2(found.gradients[name], wanted.gradients[name]) < 1e-4, name


@pytest.mark.gpu
def test_every_run_on_the_gpu_gives_the_same_bits(gpu: str) -> None:
    gaussians = random_gaussians(2000, seed=2, dtype=torch.float32, scale=(0.02, 0.15))
    camera = look_at((2.2, 1.0, 0.8), width=200, height=150, focal=220.0)
    options = RenderOptions(statistics=True)
    weights = random_weights(camera, options)
    runs = [
        outcome(render, gaussians, camera, options, weights=weights, device=gpu) for _ in range(3)
    ]
    assert_bitwise_equal(runs[1], runs[0])
    assert_bitwise_equal(runs[2], runs[0])


@pytest.mark.gpu
def test_nothing_visible_and_no_gaussian_on_the_gpu(gpu: str) -> None:
    away = isotropic([(0.0, -9.0, 0.0)], [0.1], [0.9], torch.float32)
    camera = look_at((0.0, -3.0, 0.0), width=18, height=10)
    for gaussians in (away, away.select(torch.zeros(1, dtype=torch.bool))):
        found, wanted = on_both(gaussians, camera, RenderOptions(statistics=True))
        for name in IMAGES:
            assert torch.equal(found.images[name], wanted.images[name]), name
        assert not any(gradient.any() for gradient in found.gradients.values())


@pytest.mark.gpu
def test_a_budget_too_small_is_a_typed_error(gpu: str) -> None:
    gaussians = leaves(random_gaussians(50, seed=1, dtype=torch.float32), torch.float32, gpu)
    with pytest.raises(ResourceError, match="tile intersections"):
        render_cuda(gaussians, CAMERA, budget_bytes=1000)
