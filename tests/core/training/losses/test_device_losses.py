# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses of the CUDA text, emulated or on a GPU, equal those of the compiled CPU kernels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.image_metrics import RADIUS
from gaussian_wrapping_addon.core.render.cuda import kernels
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthPrior
from gaussian_wrapping_addon.core.training import adam
from gaussian_wrapping_addon.core.training import losses as prior_module
from gaussian_wrapping_addon.core.training.device_losses import (
    device_color_loss,
    device_normal_losses,
    device_prior_loss,
)
from gaussian_wrapping_addon.core.training.losses import (
    MIN_NORMAL_SQ,
    color_loss,
    depth_prior_loss,
    normal_losses,
)
from tests.core.device_kernels import DEVICES, kernels_of

SIZES = [(33, 17), (48, 40), (16, 16), (70, 11), (9, 30)]


def random_camera(width: int, height: int, seed: int) -> Camera:
    random = np.random.default_rng(seed)
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    pose = np.concatenate([rotation, random.normal(size=(3, 1))], 1)
    center = (0.47 * width, 0.52 * height)
    return Camera("a", width, height, 1.1 * width, 1.2 * width, *center, pose)


def random_mask(width: int, height: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width)) > 0.3


def window_counts(mask: np.ndarray) -> tuple[int, int]:
    height, width = mask.shape
    inner = mask[RADIUS : height - RADIUS, RADIUS : width - RADIUS]
    return int(mask.sum()), int(inner.sum()) if min(mask.shape) > 2 * RADIUS else 0


def relative(found: torch.Tensor, wanted: np.ndarray) -> float:
    difference = found.cpu().double().numpy() - wanted
    return float(np.linalg.norm(difference) / max(np.linalg.norm(wanted), 1e-30))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [False, True])
def test_color_loss(request, device: str, size: tuple[int, int], masked: bool) -> None:  # type: ignore[no-untyped-def]
    kernels = kernels_of(device, request)
    width, height = size
    random = np.random.default_rng(width)
    image = random.random((height, width, 3), np.float32)
    photo = random.integers(0, 256, (height, width, 3), np.uint8)
    image[2, 3] = photo[2, 3] / np.float32(255)  # no sign of the error
    mask = random_mask(width, height, 5) if masked else None
    counts = window_counts(np.ones((height, width), np.bool_) if mask is None else mask)
    wanted = color_loss(image, photo, mask, lambda_dssim=0.3, threads=1)
    value, gradient, squared = device_color_loss(
        kernels,
        on(device, image),
        on(device, photo).float() * np.float32(1.0 / 255.0),
        None if mask is None else on(device, mask),
        lambda_dssim=0.3,
        counts=counts,
    )
    assert abs(float(value) - wanted[0]) <= 2e-6 * abs(wanted[0])
    assert abs(float(squared) - wanted[2].mean_squared) <= 2e-6 * wanted[2].mean_squared
    assert relative(gradient, wanted[1]) < 5e-6
    if mask is not None:
        assert not gradient.cpu().numpy()[~mask].any()


@pytest.mark.parametrize("device", DEVICES)
def test_color_loss_of_a_mask_that_leaves_nothing(request, device: str) -> None:  # type: ignore[no-untyped-def]
    kernels = kernels_of(device, request)
    image = on(device, np.full((20, 20, 3), 0.5, np.float32))
    mask = on(device, np.zeros((20, 20), np.bool_))
    value, gradient, squared = device_color_loss(
        kernels, image, 0.5 * image, mask, lambda_dssim=0.2, counts=(0, 0)
    )
    assert float(value) == 0.0
    assert float(squared) == 0.0
    assert not gradient.any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [False, True])
def test_normal_losses(request, device: str, size: tuple[int, int], masked: bool) -> None:  # type: ignore[no-untyped-def]
    kernels = kernels_of(device, request)
    width, height = size
    random = np.random.default_rng(height)
    camera = random_camera(width, height, 3)
    depth = (2.0 + 0.1 * random.random((height, width))).astype(np.float32)
    depth[random.random((height, width)) > 0.95] = 0.0
    alpha = random.random((height, width), np.float32)
    alpha[1, 1] = 0.0
    normals = [random.normal(size=(height, width, 3)).astype(np.float32) for _ in range(2)]
    mask = random_mask(width, height, 7) if masked else None
    value, wanted, _ = normal_losses(
        depth, *normals, alpha, camera, mask, lambda_depth_normal=0.7, lambda_normal=0.4, threads=1
    )
    found_value, found = device_normal_losses(
        kernels,
        on(device, depth),
        *(on(device, normal) for normal in normals),
        on(device, alpha),
        camera,
        None if mask is None else on(device, mask),
        lambda_depth_normal=0.7,
        lambda_normal=0.4,
        pixels=width * height if mask is None else int(mask.sum()),
    )
    assert abs(value) > 1e-4
    assert abs(float(found_value) - value) <= 3e-5 * abs(value) + 1e-6
    for name in ("depth", "geometric_normal", "normal", "alpha"):
        # 5e-5: the normal of a nearly flat depth is a difference of nearly equal float32.
        assert relative(getattr(found, name), getattr(wanted, name)) < 5e-5, name


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("masked", [False, True])
def test_prior_loss(request, device: str, masked: bool) -> None:  # type: ignore[no-untyped-def]
    kernels = kernels_of(device, request)
    random = np.random.default_rng(4)
    camera, other = random_camera(37, 23, 1), random_camera(18, 11, 1)
    there = np.full((11, 18), 2.0, np.float32)
    there[random.random((11, 18)) > 0.9] = 0.0
    depth = (2.0 * (1.0 + 0.04 * random.normal(size=(23, 37)))).astype(np.float32)
    depth[3, :5] = 0.0
    confidence = random.random((11, 18)).astype(np.float32)
    mask = random_mask(37, 23, 2) if masked else None
    prior = DepthPrior(other, there, confidence, there, there)
    value, wanted = depth_prior_loss(depth, camera, prior, mask, weight=0.8, threads=1)
    found_value, found = device_prior_loss(
        kernels,
        on(device, depth),
        camera,
        (on(device, there), on(device, confidence), other),
        None if mask is None else on(device, mask),
        weight=0.8,
        pixels=depth.size if mask is None else int(mask.sum()),
    )
    assert value > 0.0
    assert abs(float(found_value) - value) <= 2e-6 * value
    assert found.depth is not None
    assert wanted.depth is not None
    assert relative(found.depth, wanted.depth) < 1e-6


def test_the_source_has_the_numbers_of_the_cpu_kernels() -> None:
    text = kernels.cuda_source()
    for name, value in {
        "MIN_NORMAL_SQ": MIN_NORMAL_SQ,
        "ADAM_BETA1": adam.BETA1,
        "ADAM_BETA2": adam.BETA2,
        "ADAM_EPSILON": adam.EPSILON,
    }.items():
        assert f"#define {name} {value!r}f\n" in text
    assert f"#define PRIOR_TOLERANCE {prior_module.TOLERANCE_SHARE!r}\n" in text
    assert f"#define PRIOR_OUTLIER {prior_module.OUTLIER_SHARE!r}\n" in text


def on(device: str, array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).to("cuda" if device == "cuda" else "cpu")
